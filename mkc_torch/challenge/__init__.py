"""The blind proof: recordings with hidden physics, and the score of diagnoses made without the key.

The generator shares no code with the catalogue of effects and uses other functional forms of the same physics.
"""

from mkc_torch.challenge.key import Key
from mkc_torch.challenge.magnetometer.generator import draw
from mkc_torch.challenge.run import run_challenge
from mkc_torch.challenge.score import Score, score
from mkc_torch.challenge.subject import Case

__all__ = ["Case", "Key", "Score", "draw", "run_challenge", "score"]
