"""What surrounds the robot (`SceneSpec`) and how far the robot is from it (`ClearanceModel`)."""
