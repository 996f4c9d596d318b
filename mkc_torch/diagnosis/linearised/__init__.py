"""The linearised problem: tangents, the search over candidates, and drift of the sensors."""
