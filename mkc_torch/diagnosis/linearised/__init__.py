"""The linearised problem: tangents, the search over them, noise that wanders beside them."""
