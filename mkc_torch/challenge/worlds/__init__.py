"""The proof in worlds: each drawn, diagnosed and scored on its own."""

from mkc_torch.challenge.worlds.run import run_worlds
from mkc_torch.challenge.worlds.score import WorldScore, WorldsScore, score_worlds

__all__ = ["WorldScore", "WorldsScore", "run_worlds", "score_worlds"]
