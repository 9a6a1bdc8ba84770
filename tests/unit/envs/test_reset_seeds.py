import numpy as np

from music_rllib.envs.make import reset_seed


def test_reset_seeds_fit_into_a_signed_integer_and_rarely_repeat() -> None:
    seeds = {reset_seed(np.random.SeedSequence((0, number))) for number in range(2000)}
    assert max(seeds) < 2**31
    assert min(seeds) >= 0
    assert len(seeds) == 2000
