"""The stages of a diagnosis, in the order in which it runs them."""
