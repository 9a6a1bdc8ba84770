"""Train TAC with hindsight on an environment of your own (for sweeps: add_an_environment.md)."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from music_rllib import TACConfig


class PointGoal(gym.Env):
    """A point in the plane that moves to a goal; reward 0 within 0.1 of it, else -1."""

    def __init__(self):
        self.action_space = box = spaces.Box(-1.0, 1.0, (2,))
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -(np.linalg.norm(achieved_goal - desired_goal, axis=-1) > 0.1).astype(np.float32)

    def observe(self):
        return {"observation": self.point, "achieved_goal": self.point, "desired_goal": self.goal}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.point, self.goal = self.np_random.uniform(-1, 1, (2, 2)).astype(np.float32)
        return self.observe(), {}

    def step(self, action):
        self.point = np.clip(self.point + 0.2 * action, -1, 1).astype(np.float32)
        reward = float(self.compute_reward(self.point, self.goal, {}))
        return self.observe(), reward, False, False, {"is_success": reward == 0}


gym.register("PointGoal-v0", PointGoal, max_episode_steps=20)

if __name__ == "__main__":
    config = TACConfig().environment("PointGoal-v0").replay(hindsight_k=4).debugging(seed=0)
    algo = config.training(gamma=0.9, hidden_sizes=[64, 64], replay_ratio=0.3).build_algo()
    for _ in range(10):
        print(f"success {algo.train()['env_runners']['success_last_step']:.0%}")
