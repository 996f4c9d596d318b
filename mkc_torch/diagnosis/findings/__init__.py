"""What is told of a finding: its numbers, where it acts, what to do, what to record next."""
