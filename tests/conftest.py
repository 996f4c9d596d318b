"""One thread a worker: results do not depend on it, and workers do not fight over the cores."""

import torch

torch.set_num_threads(1)
