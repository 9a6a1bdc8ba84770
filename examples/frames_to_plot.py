"""Plot the learning curves of each condition.

Usage: python frames_to_plot.py results/NAME curves.svg

The place is a sweep's folder or an export, such as docs/results/data/claims-push.
"""

import sys

import matplotlib.pyplot as plt

from music_rllib import load_sweep

if len(sys.argv) != 3:
    sys.exit(__doc__)
place, target = sys.argv[1:]
frames = load_sweep(place)
stage = frames.runs["stage"].iloc[-1]
curves = frames.curves.join(frames.runs, on="key")
success = curves.query("stage == @stage and metric == primary_metric")
figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
for (task, condition), runs in success.groupby(["task", "condition"]):
    seeds = runs.pivot(index="env_steps", columns="seed", values="value")
    seeds = seeds.interpolate("index", limit_area="inside")  # seeds may be evaluated at other steps
    label = f"{task}, {condition} (mean of {seeds.shape[1]} seeds)"
    (mean,) = axes.plot(seeds.mean(axis=1), label=label)
    axes.plot(seeds, color=mean.get_color(), linewidth=0.4)
axes.set(xlabel="environment steps", title=f"{frames.name}, {stage}")
axes.set_ylabel(" or ".join(success["metric"].unique()))
axes.legend()
figure.savefig(target)
print(f"wrote {target}")
