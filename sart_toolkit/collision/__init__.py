"""How far a robot is from what surrounds it, and proofs that a path stays clear."""
