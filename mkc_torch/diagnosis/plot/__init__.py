"""What a diagnosis draws, each picture on one pair of axes; the report places the same drawings on its page."""
