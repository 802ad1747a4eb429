"""How the tool moves: straight lines in time (`StraightLine`) and following them (`ToolController`)."""
