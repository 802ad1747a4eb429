"""The records that the stages hand to each other, and the only reader and writer of their files."""
