"""What surrounds the robot, how far the robot is from it, and proofs that a path stays clear."""
