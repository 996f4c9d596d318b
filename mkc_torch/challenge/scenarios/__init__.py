"""The proof in worlds: each drawn, diagnosed and scored on its own."""

from mkc_torch.challenge.scenarios.run import run_worlds
from mkc_torch.challenge.scenarios.score import ScenarioScore, ScenariosScore, score_worlds

__all__ = ["ScenarioScore", "ScenariosScore", "run_worlds", "score_worlds"]
