"""What came of a run, to look at: page, figures, videos, player."""
