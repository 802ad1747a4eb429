"""Teaching: teleoperation and its recorder, scripted operators, and radius suggestion."""
