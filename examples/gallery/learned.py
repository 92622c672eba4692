"""A learned simulator: message passing over the edges of a list learns the forces of a repulsion.

python examples/gallery/learned.py [PICTURE]
pip install -e '.[warp]' matplotlib
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jfrnn

N, CUTOFF, EDGES = 200, 0.12, 2600


def true_force(r, i, j):
    """What is to be learned: particles repel each other, and the force ends smoothly at the cutoff."""
    s = r @ r / CUTOFF**2
    return -jnp.sin(jnp.pi * s) * r / CUTOFF


def layer(key, wide, high):
    """Return weights and biases at random."""
    return jax.random.normal(key, (wide, high)) * (2 / wide) ** 0.5, jnp.zeros(high)


def network(weights, x, nbrs):
    """Each edge makes a message of its length; a particle sums messages along its edges' directions."""
    edges = nbrs.edges(x)
    length = jnp.sqrt((edges.displacement**2).sum(-1, keepdims=True) + 1e-12)
    h = jnp.concatenate([length / CUTOFF, (length / CUTOFF) ** 2], axis=1)
    for w, b in weights[:-1]:
        h = jax.nn.silu(h @ w + b)
    message = (h @ weights[-1][0] + weights[-1][1]) * edges.displacement / length
    message = jnp.where(edges.mask[:, None], message, 0)
    return jax.ops.segment_sum(message, edges.receivers, N, indices_are_sorted=True)


@jax.jit
def train(weights, means, squares, key):
    """One step of RMSprop with momentum on a scene that was not there before."""
    x = jax.random.uniform(key, (N, 2))
    nbrs, true = jfrnn.search_edges(x, CUTOFF, total=EDGES), jfrnn.pair_sum(true_force, x, CUTOFF)
    loss, slope = jax.value_and_grad(lambda w: jnp.mean((network(w, x, nbrs) - true) ** 2))(weights)
    means = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, means, slope)
    squares = jax.tree.map(lambda s, g: 0.99 * s + 0.01 * g**2, squares, slope)
    weights = jax.tree.map(lambda w, m, s: w - 2e-3 * m / (jnp.sqrt(s) + 1e-8), weights, means, squares)
    return weights, means, squares, loss / jnp.mean(true**2), nbrs.status


def main(steps=200):
    """Return the losses of all steps, as a share of the mean square of the forces."""
    keys = jax.random.split(jax.random.key(0), 3)
    weights = [layer(keys[0], 2, 32), layer(keys[1], 32, 32), layer(keys[2], 32, 1)]
    means, losses = jax.tree.map(jnp.zeros_like, weights), []
    squares = means
    for key in jax.random.split(jax.random.key(2), steps):
        weights, means, squares, loss, status = train(weights, means, squares, key)
        if status != 0:
            raise RuntimeError(f"{jfrnn.Status(int(status))}: more edges are needed")
        losses.append(float(loss))
    print(
        f"squared error of the forces, over their square: {losses[0]:.2f} at first, "
        f"{losses[-1]:.1e} after {steps} steps"
    )
    assert losses[-1] < 0.2 * losses[0], "it has not learned: take more steps"
    return losses


if __name__ == "__main__":
    losses = main()
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.semilogy(losses)
    title = f"{len(losses)} steps of training leave {losses[-1]:.1%} of squared error in the forces"
    axes.set(xlabel="step, each on a new scene", ylabel="squared error / square of forces", title=title)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "learned.png", dpi=100)
