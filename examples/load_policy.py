"""Load a trained policy without Ray and play an episode.

Usage: python load_policy.py results/NAME/best
"""

import sys

import gymnasium as gym
import gymnasium_robotics

from music_rllib.policy import load_policy

if len(sys.argv) != 2:
    sys.exit(__doc__)
gym.register_envs(gymnasium_robotics)
policy = load_policy(sys.argv[1])
options = {**policy.task.env_kwargs, "max_episode_steps": policy.max_episode_steps}
env = gym.make(policy.task.env_id, **options)
observation, _ = env.reset(seed=0)
total, done = 0.0, False
while not done:
    observation, reward, terminated, truncated, info = env.step(policy.act(observation))
    total, done = total + reward, terminated or truncated
success = float(info.get(policy.task.success_key, "nan"))
print(f"return {total:g}, success {success:g}")
