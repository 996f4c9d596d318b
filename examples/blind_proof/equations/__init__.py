"""The blind proof of differential equations: systems that share no code with the catalogue."""
