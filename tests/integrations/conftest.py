from importlib.util import find_spec

import pytest


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """PyTorch would start a thread for each core."""
    if find_spec("torch"):
        import torch

        torch.set_num_threads(1)
