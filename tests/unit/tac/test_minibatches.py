"""Minibatches of several updates at once have the values of one after another."""

import torch

from music_rllib.intrinsic.estimator import MutualInformationEstimator
from music_rllib.intrinsic.music import Music
from music_rllib.intrinsic.settings import MusicSettings
from music_rllib.tac.minibatches import Minibatches


def test_rewards_of_updates_with_equal_draws_equal_those_of_each_update() -> None:
    torch.manual_seed(0)
    settings = MusicSettings(estimator="frozen", mi_reward_weight=1.0, shuffle="random")
    music = Music(settings, MutualInformationEstimator(range(3), range(3, 6), hidden_size=16))
    drawn = [(True, False), (False, False), (True, False), (True, True), (True, False)]
    rows = len(drawn) * 512
    columns = {name: torch.randn(rows, 6) for name in ("obs", "new_obs")}
    together = Minibatches({"default_policy": columns}, drawn)
    alone = [one.music_rewards(music) for one in together.one_by_one()]
    torch.testing.assert_close(together.music_rewards(music), torch.cat(alone))
    assert (alone[0][0, 256:] == -1.0).all()
    assert not (alone[0][0, :256] == -1.0).all()
