"""Files that a diagnosis is written to and read from."""
