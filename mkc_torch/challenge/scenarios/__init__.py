"""The proof in scenarios, each of which is drawn, diagnosed and scored separately."""

from mkc_torch.challenge.scenarios.run import run_scenarios
from mkc_torch.challenge.scenarios.score import ScenarioScore, ScenariosScore, score_scenarios

__all__ = ["ScenarioScore", "ScenariosScore", "run_scenarios", "score_scenarios"]
