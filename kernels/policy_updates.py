"""Parts of PPO that are no products of matrices: returns, layers of ELU, losses with their gradients, Adam."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

CHUNK = 32  # samples of a partial sum
Four = wp.types.matrix((4, 2), wp.float32)  # pairs of four samples


@wp.func
def split(word: wp.uint64) -> wp.vec2f:
    """Return the two numbers of float32 that a word holds, or of bfloat16."""
    low, high = wp.uint32(word & wp.uint64(0xFFFFFFFF)), wp.uint32(word >> wp.uint64(32))
    return wp.vec2f(wp.cast(low, wp.float32), wp.cast(high, wp.float32))


@wp.func  # type: ignore[no-redef]
def split(word: wp.uint32) -> wp.vec2f:  # noqa: F811
    high = (word >> wp.uint32(16)) << wp.uint32(16)
    return wp.vec2f(wp.cast(word << wp.uint32(16), wp.float32), wp.cast(high, wp.float32))


@wp.func
def join(low: wp.float32, high: wp.float32, like: wp.uint64) -> wp.uint64:
    """Return the word of two numbers, of the kind of ``like``."""
    return wp.uint64(wp.cast(low, wp.uint32)) | (wp.uint64(wp.cast(high, wp.uint32)) << wp.uint64(32))


@wp.func  # type: ignore[no-redef]
def join(low: wp.float32, high: wp.float32, like: wp.uint32) -> wp.uint32:  # noqa: F811
    a, b = wp.cast(wp.bfloat16(low), wp.uint16), wp.cast(wp.bfloat16(high), wp.uint16)
    return wp.uint32(a) | (wp.uint32(b) << wp.uint32(16))


@wp.func
def elu(x: wp.float32) -> wp.float32:
    if not x > 0.0:
        x = wp.exp(x) - 1.0
    return x


@wp.func
def slope_of_elu(y: wp.float32) -> wp.float32:
    """Return the slope of ELU where its result is ``y``."""
    slope = y + 1.0
    if y > 0.0:
        slope = 1.0
    return slope


@wp.kernel
def compute_returns(
    rewards: wp.array2d(dtype=wp.float32), dones: wp.array2d(dtype=wp.uint8), values: wp.array2d(dtype=wp.float32),
    last: wp.array(dtype=wp.float32), discount: float, trace: float,
    returns: wp.array2d(dtype=wp.float32), advantages: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Compute returns and advantages of a rollout [step, world] backwards from the values of the last observations.

    Schulman et al. 2016, "High-dimensional continuous control using generalized advantage estimation". Threads: worlds.
    """
    world = wp.tid()
    steps = rewards.shape[0]
    after = last[world]
    advantage = wp.float32(0.0)
    for i in range(steps):
        step = steps - 1 - i
        value = values[step, world]
        goes_on = 1.0 - wp.float32(dones[step, world])
        error = rewards[step, world] + goes_on * discount * after - value
        advantage = error + goes_on * discount * trace * advantage
        found = advantage + value
        returns[step, world] = found
        advantages[step, world] = found - value
        after = value


@wp.kernel
def add_bias_and_elu(values: wp.array2d(dtype=Any), bias: wp.array(dtype=wp.vec2f)):
    """Set values [sample, pair of units] to ``elu(values + bias)``; threads (ceil(samples / 4), pairs)."""
    part, pair = wp.tid()
    last, offset = values.shape[0] - 1, bias[pair]
    found = Four()
    for k in range(4):
        x = split(values[wp.min(4 * part + k, last), pair]) + offset
        found[k] = wp.vec2f(elu(x[0]), elu(x[1]))
    for k in range(4):
        values[wp.min(4 * part + k, last), pair] = join(found[k, 0], found[k, 1], values.dtype(0))


@wp.kernel
def differentiate_elu(
    results: wp.array2d(dtype=Any), gradient: wp.array2d(dtype=Any), sums: wp.array2d(dtype=wp.vec2f)
):
    """Make of the gradient of ELU's results that of its arguments [sample, pair of units], and sum it over parts.

    Threads (ceil(samples / 32), pairs), as ``sums`` [part, pair] has entries.
    """
    part, pair = wp.tid()
    count = results.shape[0]
    total = wp.vec2f()
    for i in range(8):
        start = 32 * part + 4 * i
        found = Four()
        for k in range(4):
            row = wp.min(start + k, count - 1)
            y, above = split(results[row, pair]), split(gradient[row, pair])
            found[k] = wp.vec2f(above[0] * slope_of_elu(y[0]), above[1] * slope_of_elu(y[1]))
        for k in range(4):
            if start + k < count:
                gradient[start + k, pair] = join(found[k, 0], found[k, 1], gradient.dtype(0))
                total += found[k]
    sums[part, pair] = total


@wp.kernel
def surrogate_loss(
    means: wp.array2d(dtype=Any), bias: wp.array(dtype=wp.float32), deviations: wp.array(dtype=wp.float32),
    least: float, most: float, actions: wp.array2d(dtype=wp.float32), old_means: wp.array2d(dtype=wp.float32),
    old_deviations: wp.array2d(dtype=wp.float32), old_log_prob: wp.array2d(dtype=wp.float32),
    advantages: wp.array2d(dtype=wp.float32), clip: float,
    gradient: wp.array2d(dtype=Any), terms: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Compute PPO's clipped surrogate loss of a Gaussian policy, a thread a sample.

    Args:
        means: of the policy, without ``bias`` [sample, action]. deviations: before they are clamped to ``least`` to
            ``most`` [action].
        gradient: of the mean loss with respect to means [sample, action].
        terms: parts of sums over samples [2 actions + 2, sample]: the gradient with respect to deviations and to
            ``bias``, the loss, the KL divergence of the new policy from the old one.
    """
    i = wp.tid()
    count, size = actions.shape[0], actions.shape[1]
    share = 1.0 / wp.float32(count)
    log_prob = wp.float32(0.0)
    divergence = wp.float32(0.0)
    for j in range(size):
        mean, deviation = wp.float32(means[i, j]) + bias[j], wp.clamp(deviations[j], least, most)
        off = (actions[i, j] - mean) / deviation
        log_prob -= 0.5 * off * off + wp.log(deviation) + 0.5 * 1.8378770664093453
        ratio = old_deviations[i, j] / deviation
        moved = (old_means[i, j] - mean) / deviation
        divergence += 0.5 * (ratio * ratio + moved * moved - 1.0) - wp.log(ratio)
    weight = wp.exp(log_prob - old_log_prob[i, 0])
    loss = -advantages[i, 0] * weight
    clipped = -advantages[i, 0] * wp.clamp(weight, 1.0 - clip, 1.0 + clip)
    slope = loss * share
    if loss < clipped:  # false for NaN, which reaches the gradient
        loss = clipped
        slope = 0.0
    for j in range(size):
        mean, deviation = wp.float32(means[i, j]) + bias[j], wp.clamp(deviations[j], least, most)
        off = (actions[i, j] - mean) / deviation
        entry = slope * off / deviation
        gradient[i, j] = gradient.dtype(entry)
        terms[j, i] = slope * (off * off - 1.0) / deviation
        terms[size + j, i] = entry
    terms[2 * size, i] = loss * share
    terms[2 * size + 1, i] = divergence * share


@wp.kernel
def value_loss(
    values: wp.array2d(dtype=Any), bias: wp.array(dtype=wp.float32), old_values: wp.array2d(dtype=wp.float32),
    returns: wp.array2d(dtype=wp.float32), clip: float, clips: bool, coefficient: float,
    gradient: wp.array2d(dtype=Any), terms: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Compute PPO's value loss, a thread a sample.

    Args:
        values: without ``bias`` [sample, 1]. clips: whether values are clipped around ``old_values``.
        coefficient: of the loss in ``gradient`` with respect to values [sample, 1].
        terms: parts of sums over samples: the gradient with respect to ``bias``, the loss [2, sample].
    """
    i = wp.tid()
    share = 1.0 / wp.float32(values.shape[0])
    value = wp.float32(values[i, 0]) + bias[0]
    error = value - returns[i, 0]
    loss, slope = error * error, 2.0 * error
    if clips:
        step = value - old_values[i, 0]
        near = old_values[i, 0] + wp.clamp(step, -clip, clip) - returns[i, 0]
        if loss < near * near:
            loss = near * near
            slope = 0.0
            if step >= -clip and step <= clip:
                slope = 2.0 * near
    slope = slope * coefficient * share
    gradient[i, 0] = gradient.dtype(slope)
    terms[0, i] = slope
    terms[1, i] = loss * share


@wp.kernel
def adapt(
    sums: wp.array(dtype=wp.float32), deviations: wp.array(dtype=wp.float32), least: float, most: float,
    entropy_weight: float, target: float, beta1: wp.float64, beta2: wp.float64,
    gradient: wp.array(dtype=wp.float32), bias_gradient: wp.array(dtype=wp.float32),
    rate: wp.array(dtype=wp.float32), steps: wp.array(dtype=wp.float32), corrections: wp.array(dtype=wp.float32),
    entropy: wp.array(dtype=wp.float32),
):  # fmt: skip
    """Finish the gradients of deviations and of the last bias, adapt the learning rate, and count a step of Adam.

    Args:
        sums: of ``terms`` of ``surrogate_loss``. target: KL divergence that the rate adapts to; 0: it does not.
        corrections: of Adam's averages: 1 - beta1^steps and the square root of 1 - beta2^steps.
        entropy: of the policy. Threads: actions.
    """
    j = wp.tid()
    size = deviations.shape[0]
    deviation = deviations[j]
    gradient[j] = 0.0
    if deviation >= least and deviation <= most:
        gradient[j] = sums[j] - entropy_weight / deviation
    if not wp.isfinite(deviation):
        gradient[j] = deviation
    bias_gradient[j] = sums[size + j]
    if j == 0:
        total = wp.float32(0.0)
        for k in range(size):
            total += 0.5 + 0.5 * 1.8378770664093453 + wp.log(wp.clamp(deviations[k], least, most))
        entropy[0] = total
        divergence = sums[2 * size + 1]
        if target > 0.0:
            if divergence > 2.0 * target:
                rate[0] = wp.max(rate[0] / 1.5, 1e-5)
            elif divergence < 0.5 * target and divergence > 0.0:
                rate[0] = wp.min(rate[0] * 1.5, 1e-2)
        count = steps[0] + 1.0
        steps[0] = count
        corrections[0] = wp.float32(wp.float64(1.0) - wp.pow(beta1, wp.float64(count)))
        corrections[1] = wp.float32(wp.sqrt(wp.float64(1.0) - wp.pow(beta2, wp.float64(count))))


@wp.kernel
def clip_and_step(
    weights: wp.array(dtype=wp.float32), gradients: wp.array(dtype=wp.float32), first: wp.array(dtype=wp.float32),
    second: wp.array(dtype=wp.float32), copies: wp.array(dtype=Any), border: int, norms: wp.array(dtype=wp.float32),
    largest: float, beta1: float, beta2: float, tiny: float, rate: wp.array(dtype=wp.float32),
    corrections: wp.array(dtype=wp.float32),
):  # fmt: skip
    """Take Adam's step along gradients that are clipped to a norm, a thread a weight.

    Args:
        first, second: Adam's averages. copies: of the weights, in the dtype of products.
        border: weights before it belong to the network of ``norms[0]``, others to that of ``norms[1]``.
    """
    i = wp.tid()
    norm = norms[0]
    if i >= border:
        norm = norms[1]
    scale = largest / (norm + 1e-6)
    if scale > 1.0:
        scale = 1.0
    g = gradients[i] * scale
    m = first[i] + (g - first[i]) * (1.0 - beta1)
    v = beta2 * second[i] + (1.0 - beta2) * g * g
    first[i] = m
    second[i] = v
    w = weights[i] - rate[0] / corrections[0] * m / (wp.sqrt(v) / corrections[1] + tiny)
    weights[i] = w
    if copies.shape[0] > 0:
        copies[i] = copies.dtype(w)


def add_overloads() -> None:
    """Name the dtypes of products, so that all kernels are compiled at once."""
    flat, rows = wp.array(dtype=wp.float32), wp.array2d(dtype=wp.float32)
    for T in (wp.float32, wp.bfloat16):
        own, words = wp.array2d(dtype=T), wp.array2d(dtype=wp.uint64 if T is wp.float32 else wp.uint32)
        add_bias_and_elu.add_overload([words, wp.array(dtype=wp.vec2f)])
        differentiate_elu.add_overload([words, words, wp.array2d(dtype=wp.vec2f)])
        surrogate_loss.add_overload([own, flat, flat, float, float, rows, rows, rows, rows, rows, float, own, rows])
        value_loss.add_overload([own, flat, rows, rows, float, bool, float, own, rows])
        copies = wp.array(dtype=T)
        numbers = [flat, flat, flat, flat, copies, int, flat, float, float, float, float, flat, flat]
        clip_and_step.add_overload(numbers)


add_overloads()
