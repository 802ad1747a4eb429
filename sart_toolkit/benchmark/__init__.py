"""Plans of skills to learn and evaluate, and measurements of the toolkit itself."""
