"""Something of one's own: a first `RobotSpec` from a URDF, its examination, files to begin with."""
