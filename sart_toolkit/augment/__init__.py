"""Self-augmentation: which poses to visit (strategies) and visiting them (engine)."""
