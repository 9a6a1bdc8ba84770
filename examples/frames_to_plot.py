"""Plot learning curves over q.

Usage: python frames_to_plot.py results/NAME curves.svg

The place is a sweep's folder or an export, such as docs/results/data/claims-push.
"""

import sys

import matplotlib.pyplot as plt

from music_rllib import load_sweep

place, target = sys.argv[1:]
frames = load_sweep(place)
stage = frames.runs["stage"].iloc[-1]
curves = frames.curves.join(frames.runs, on="key")
success = curves.query("stage == @stage and metric == 'evaluation/success_rate'")
figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
for q, runs in success.groupby("q"):
    seeds = runs.pivot_table(index="env_steps", columns="seed", values="value")
    (mean,) = axes.plot(seeds.mean(axis=1), label=f"q = {q:g} (mean of {seeds.shape[1]} seeds)")
    axes.plot(seeds, color=mean.get_color(), linewidth=0.4)
axes.set(xlabel="environment steps", ylabel="success rate", title=f"{frames.name}, {stage}")
axes.legend()
figure.savefig(target)
print(f"wrote {target}")
