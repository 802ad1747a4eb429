"""Where a camera is mounted, measured with a printed board, and how far that may be off."""
