"""A robot of one's own: a first `RobotSpec` from its URDF, and an examination before it moves."""
