"""FMUs that the tests compile themselves, and what is asked of them."""
