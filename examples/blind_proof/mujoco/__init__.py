"""The proof of models of MuJoCo: recordings are stepped by MuJoCo itself, with elements that the user's file lacks."""
