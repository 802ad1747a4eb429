"""Windows over episodes, policies, the one training loop, and trained skills."""
