"""The words that a reader sees, in reports, in pictures and on the terminal, and how they are set."""
