"""The blind proof: recordings with hidden physics, and the score of diagnoses made without the key.

The generator shares no code with the catalogue of effects and uses other functional forms of the same physics.
"""
