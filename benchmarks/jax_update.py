"""The same TAC update in JAX, compiled as a whole: an update without any overhead of Python.

Critics evaluate the minibatch's and the policy's actions in two passes. XLA skips the gradients of
weights that are not used.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

# JAX reads it when it creates its CPU client; otherwise XLA uses every core.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["jax_updates"]

Layers = list[tuple[Any, Any]]
ADAM = (1e-3, 0.9, 0.999, 1e-8)
TAU, GAMMA = 0.005, 0.98


def jax_updates(
    inputs: int, actions: int, hidden: Sequence[int], batch: int, updates: int, *, q: float,
    alpha: float,
) -> Callable[[], None]:  # fmt: skip
    """A turn of `updates` updates in one call, on data that is already in memory."""
    rng = np.random.default_rng(0)

    def network(first: int, last: int) -> Layers:
        sizes = [first, *hidden, last]
        return [
            (jnp.asarray(rng.uniform(-1, 1, (i, o)) / math.sqrt(i), jnp.float32), jnp.zeros(o))
            for i, o in pairwise(sizes)
        ]

    trained = {
        "policy": network(inputs, 2 * actions),
        "critics": [network(inputs + actions, 1) for _ in range(2)],
        "value": network(inputs, 1),
    }
    means, squares = (jax.tree.map(jnp.zeros_like, trained) for _ in range(2))
    state = (trained, network(inputs, 1), means, squares, jnp.zeros(()))
    shape = (updates, batch)
    minibatches = {
        "obs": jnp.asarray(rng.standard_normal((*shape, inputs)), jnp.float32),
        "next_obs": jnp.asarray(rng.standard_normal((*shape, inputs)), jnp.float32),
        "actions": jnp.asarray(rng.uniform(-1, 1, (*shape, actions)), jnp.float32),
        "noise": jnp.asarray(rng.standard_normal((*shape, actions)), jnp.float32),
        "rewards": -jnp.ones(shape),
        "discounts": jnp.ones(shape),
    }
    step = _update(actions, q, alpha)
    run = jax.jit(lambda state, data: jax.lax.scan(step, state, data), donate_argnums=0)

    wait: Any = jax.block_until_ready

    def turn() -> None:
        nonlocal state
        state, losses = run(state, minibatches)
        wait(losses)

    return turn


def _update(actions: int, q: float, alpha: float) -> Callable[[Any, Any], Any]:
    def losses(trained: Any, target: Layers, data: Any) -> Any:
        following = _forward(target, _normalised(data["next_obs"]))[:, 0]
        learned = data["rewards"] + GAMMA * data["discounts"] * following
        obs = _normalised(data["obs"])
        outputs = _forward(trained["policy"], obs)
        mean, log_std = outputs[:, :actions], outputs[:, actions:].clip(-20, 2)
        raw = mean + jnp.exp(log_std) * data["noise"]
        log_jacobian = 2 * (math.log(2) - raw - jax.nn.softplus(-2 * raw))
        log_density = -0.5 * data["noise"] ** 2 - log_std - 0.5 * math.log(2 * math.pi)
        exponent = ((q - 1) * (log_density - log_jacobian)).clip(None, 10.0)
        ln_q_pi = (jnp.expm1(exponent) / (q - 1)).sum(-1)
        pairs = jnp.concatenate([obs, data["actions"]], -1)
        asked = jnp.concatenate([obs, jnp.tanh(raw)], -1)
        critics, value = trained["critics"], _forward(trained["value"], obs)[:, 0]
        errors = jnp.stack([_forward(c, pairs)[:, 0] - learned for c in critics])
        frozen = jax.lax.stop_gradient(critics)
        lowest = jnp.stack([_forward(c, asked)[:, 0] for c in frozen]).min(0)
        of_value = jax.lax.stop_gradient(lowest - alpha * ln_q_pi)
        return (
            0.5 * (errors**2).mean(-1).sum()
            + 0.5 * ((value - of_value) ** 2).mean()
            + (alpha * ln_q_pi - lowest).mean()
        )

    def step(state: Any, data: Any) -> Any:
        trained, target, means, squares, count = state
        loss, gradients = jax.value_and_grad(losses)(trained, target, data)
        lr, beta1, beta2, epsilon = ADAM
        count = count + 1
        means = jax.tree.map(lambda m, g: beta1 * m + (1 - beta1) * g, means, gradients)
        squares = jax.tree.map(lambda s, g: beta2 * s + (1 - beta2) * g * g, squares, gradients)
        rate, root = lr / (1 - beta1**count), jnp.sqrt(1 - beta2**count)
        trained = jax.tree.map(
            lambda p, m, s: p - rate * m / (jnp.sqrt(s) / root + epsilon), trained, means, squares
        )
        target = jax.tree.map(lambda t, v: t + TAU * (v - t), target, trained["value"])
        return (trained, target, means, squares, count), loss

    return step


def _normalised(inputs: Any) -> Any:
    return (inputs / 1.01).clip(-5, 5)


def _forward(layers: Layers, inputs: Any) -> Any:
    for weight, bias in layers[:-1]:
        inputs = jax.nn.relu(inputs @ weight + bias)
    weight, bias = layers[-1]
    return inputs @ weight + bias
