"""How the tool moves: straight lines in time, and the `ToolController` that follows them."""
