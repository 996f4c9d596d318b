"""Words that a reader sees: numbers, symbols, terms."""
