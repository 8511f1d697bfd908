"""Updates of PPO in few kernels: products of matrices by torch, all else fused: :class:`FusedUpdate`."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn

from ..kernels import policy_updates as kernels
from ..runtime.launches import launch
from ..runtime.torch_tensors import stream

ALIGNED = 64  # weights from one array to the next: products read and write whole lines of memory
WIDE = 16  # what products take at once: layers, their inputs and their results are filled up with zeros to multiples
FEW = 64  # threads of a block where there are few

_compiling: list[threading.Thread] = []  # what start_compiling has begun


class FusedBatch(NamedTuple):
    """A minibatch [sample, number]: inputs of both networks, and what the rollout has of its samples."""

    actor: torch.Tensor
    critic: torch.Tensor
    actions: torch.Tensor
    old_mean: torch.Tensor
    old_deviation: torch.Tensor
    old_log_prob: torch.Tensor
    advantages: torch.Tensor
    values: torch.Tensor
    returns: torch.Tensor


class FusedParameter(NamedTuple):
    """A parameter filled up with zeros to multiples of WIDE, its gradient, and what products read of it."""

    values: torch.Tensor
    gradient: torch.Tensor
    factor: torch.Tensor


class FusedNetwork:
    """Layers of ELU and a last one without, whose results and gradients have their places.

    Args:
        layers: weights and biases, from the first. rows: samples of a minibatch.
    """

    def __init__(self, layers: Sequence[tuple[FusedParameter, FusedParameter]], rows: int):
        device, dtype = layers[0][0].factor.device, layers[0][0].factor.dtype
        self.device = str(wp.device_from_torch(device))
        self.weights, self.biases = zip(*layers, strict=True)
        widths = [len(bias.values) for bias in self.biases]
        self.results, self.slopes = (
            [torch.zeros(rows, width, dtype=dtype, device=device) for width in widths] for _ in range(2)
        )
        parts = -(-rows // kernels.CHUNK)
        self.sums = [torch.empty(parts, width, device=device) for width in widths[:-1]]
        self.ones = torch.ones(parts, device=device)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the last layer's results without its bias [sample, number and more]."""
        for weight, bias, result in zip(self.weights, self.biases, self.results, strict=True):
            torch.mm(x, weight.factor.t(), out=result)
            if result is not self.results[-1]:
                threads = -(-len(x) // 4), result.shape[1] // 2
                start(kernels.add_bias_and_elu, threads, [pairs(result), vectors(bias.values)], self.device)
            x = result
        return x

    def backward(self, x: torch.Tensor) -> None:
        """Compute the gradients of weights from that of the last results, ``slopes[-1]``."""
        for i in reversed(range(len(self.weights))):
            slope = self.slopes[i]
            multiply(slope.t(), self.results[i - 1] if i else x, self.weights[i].gradient)
            if i:
                below, sums = self.slopes[i - 1], self.sums[i - 1]
                torch.mm(slope, self.weights[i].factor, out=below)
                threads = len(sums), sums.shape[1] // 2
                numbers = [pairs(self.results[i - 1]), pairs(below), vectors(sums)]
                start(kernels.differentiate_elu, threads, numbers, self.device)
                torch.mv(sums.t(), self.ones, out=self.biases[i - 1].gradient)


class FusedUpdate:
    """An update of actor and critic that are layers of ELU, with a Gaussian policy and Adam.

    Weights, gradients and Adam's averages of both networks lie in four arrays, of which parameters and the optimizer's
    state are views. Actor and critic run on two streams up to Adam's step, which is one kernel. Several processes
    average gradients, and the sums of losses behind them, by one call for a minibatch.

    Args:
        alg: whose networks learn; :func:`find_obstacle` says whether they can.
    """

    def __init__(self, alg: Any):
        while _compiling:
            _compiling.pop().join()
        self.alg = alg
        device = torch.device(alg.device)
        self.device = str(wp.device_from_torch(device))
        self.dtype = torch.bfloat16 if alg.use_mixed_precision else torch.float32
        models = alg._raw_actor, alg._raw_critic
        parameters = [weight for model in models for weight in model.parameters()]
        shapes = [tuple(round_up(size, WIDE) for size in weight.shape) for weight in parameters]
        sizes = [round_up(math.prod(shape), ALIGNED) for shape in shapes]
        self.border, end = sum(sizes[: len([*models[0].parameters()])]), sum(sizes)
        actions = len(alg._raw_actor.distribution.std_param)
        self.averaged = torch.zeros(end + 2 * actions + 2, device=device)
        flat = [self.averaged[:end] if i == 1 else torch.zeros(end, device=device) for i in range(4)]
        self.weights, self.gradients, self.first, self.second = flat
        self.rate = alg._rate.view(1)
        self.copies = torch.zeros(end if self.dtype != torch.float32 else 0, dtype=self.dtype, device=device)
        self.steps = torch.zeros((), device=device)
        self.gradient_of: dict[Any, torch.Tensor] = {}
        held: dict[Any, FusedParameter] = {}
        begin = 0
        for weight, shape, size in zip(parameters, shapes, sizes, strict=True):
            parts = [each[begin : begin + math.prod(shape)].view(shape) for each in (*flat, self.copies) if len(each)]
            own = [part[tuple(map(slice, weight.shape))] for part in parts]
            state = alg.optimizer.state.get(weight)
            own[0].copy_(weight.detach())
            if state:
                own[2].copy_(state["exp_avg"])
                own[3].copy_(state["exp_avg_sq"])
                self.steps.copy_(state["step"])
            alg.optimizer.state[weight] = {"step": self.steps, "exp_avg": own[2], "exp_avg_sq": own[3]}
            weight.data = own[0]
            held[weight] = FusedParameter(parts[0], parts[1], parts[4 if len(parts) > 4 else 0])
            self.gradient_of[weight] = own[1]
            begin += size
        self.group = alg.optimizer.param_groups[0]
        self.deviations = alg._raw_actor.distribution.std_param.detach()
        self.deviation_gradient = self.gradient_of[alg._raw_actor.distribution.std_param]
        rows = alg._order.shape[1]
        self.actor, self.critic = (
            FusedNetwork([(held[x.weight], held[x.bias]) for x in model.mlp if isinstance(x, nn.Linear)], rows)
            for model in models
        )
        count = alg.num_learning_epochs * alg.num_mini_batches
        self.terms = torch.empty(2 * actions + 2, rows, device=device)
        self.value_terms = torch.empty(2, rows, device=device)
        self.sums = torch.zeros(count, 2 * actions + 2, device=device)
        self.value_sums, self.entropies = torch.zeros(count, 2, device=device), torch.zeros(count, device=device)
        self.norms, self.corrections = torch.zeros(2, device=device), torch.zeros(2, device=device)

    def learned_tensors(self) -> list[torch.Tensor]:
        """Return the tensors that a step of the optimizer changes: weights, moments, the number of steps."""
        return [self.weights, self.first, self.second, self.steps]

    def deviation(self) -> torch.Tensor:
        """Return the mean deviation of actions."""
        return self.deviations.clamp(*self.alg._raw_actor.distribution.std_range).mean()

    @torch.no_grad()
    def compute_returns(self, last: torch.Tensor) -> None:
        """Compute returns and normalised advantages from the values of the last observations [world, 1]."""
        alg, held = self.alg, self.alg.storage
        rollout = [x.squeeze(-1) for x in (held.rewards, held.dones, held.values)]
        results = [held.returns.squeeze(-1), held.advantages.squeeze(-1)]
        numbers = [*rollout, last.view(-1), alg.gamma, alg.lam, *results]
        start(kernels.compute_returns, len(last), numbers, self.device)
        deviation, mean = torch.std_mean(held.advantages)
        held.advantages.sub_(mean).div_(deviation + 1e-8)

    def batch(self, held: Any) -> FusedBatch:
        """Return a minibatch of rsl_rl with the inputs of both networks."""
        alg = self.alg
        actor, critic = (self._inputs(model.get_latent(held.observations)) for model in (alg.actor, alg.critic))
        mean, deviation = held.old_distribution_params
        return FusedBatch(
            actor, critic, held.actions, mean, deviation, held.old_actions_log_prob, held.advantages, held.values,
            held.returns,
        )  # fmt: skip

    def _inputs(self, latent: torch.Tensor) -> torch.Tensor:
        """Return inputs of a network in the dtype of products, filled up with zeros."""
        count = latent.shape[1]
        return nn.functional.pad(latent.to(self.dtype), (0, round_up(count, WIDE) - count))

    @torch.no_grad()
    def learn(self, held: Sequence[Any]) -> None:
        """Take all steps of an update, and leave the sums of losses."""
        alg = self.alg
        batches = [self.batch(each) for each in held]
        if len(self.copies):
            self.copies.copy_(self.weights)
        for k in range(len(self.entropies)):
            batch = batches[k % len(batches)]
            with alg._beside():
                self._differentiate_critic(batch, k)
            self._differentiate_actor(batch, k)
            alg._join()
            if alg.is_multi_gpu:
                totals = self.averaged[len(self.gradients) :].copy_(self.sums[k])
                average(self.averaged)
                self._adapt(totals, k)
                for network in range(2):
                    self._take_norm(network)
            beta1, beta2 = self.group["betas"]
            numbers = [self.weights, self.gradients, self.first, self.second, self.copies, self.border, self.norms,
                       alg.max_grad_norm, beta1, beta2, self.group["eps"], self.rate, self.corrections]  # fmt: skip
            start(kernels.clip_and_step, len(self.weights), numbers, self.device)
        size = len(self.deviations)
        losses = [self.value_sums[:, 1].sum(), self.sums[:, 2 * size].sum(), self.entropies.sum()]
        alg._sums.copy_(torch.stack(losses))

    def _differentiate_critic(self, batch: FusedBatch, k: int) -> None:
        alg, net = self.alg, self.critic
        last = net.biases[-1].values
        values = net.forward(batch.critic)
        numbers = [values, last, batch.values, batch.returns, alg.clip_param, alg.use_clipped_value_loss,
                   alg.value_loss_coef, net.slopes[-1], self.value_terms]  # fmt: skip
        start(kernels.value_loss, len(values), numbers, self.device, FEW)
        torch.sum(self.value_terms, dim=1, out=self.value_sums[k])
        net.biases[-1].gradient[:1].copy_(self.value_sums[k, :1])
        net.backward(batch.critic)
        if not alg.is_multi_gpu:
            self._take_norm(1)

    def _differentiate_actor(self, batch: FusedBatch, k: int) -> None:
        alg, net = self.alg, self.actor
        last = net.biases[-1].values
        limits = alg._raw_actor.distribution.std_range
        means = net.forward(batch.actor)
        numbers = [means, last, self.deviations, *limits, batch.actions, batch.old_mean, batch.old_deviation,
                   batch.old_log_prob, batch.advantages, alg.clip_param, net.slopes[-1], self.terms]  # fmt: skip
        start(kernels.surrogate_loss, len(means), numbers, self.device, FEW)
        torch.sum(self.terms, dim=1, out=self.sums[k])
        if not alg.is_multi_gpu:
            self._adapt(self.sums[k], k)
        net.backward(batch.actor)
        if not alg.is_multi_gpu:
            self._take_norm(0)

    def _adapt(self, sums: torch.Tensor, k: int) -> None:
        """Finish the actor's gradients of deviations and of the last bias, and adapt the rate, by sums of losses."""
        alg = self.alg
        limits = alg._raw_actor.distribution.std_range
        numbers = [sums, self.deviations, *limits, alg.entropy_coef, alg.desired_kl if alg._adapts else 0.0,
                   *self.group["betas"], self.deviation_gradient, self.actor.biases[-1].gradient, self.rate,
                   self.steps.view(1), self.corrections, self.entropies[k : k + 1]]  # fmt: skip
        start(kernels.adapt, len(self.deviations), numbers, self.device)

    def _take_norm(self, network: int) -> None:
        """Take the norm of a network's gradients: 0: the actor, 1: the critic."""
        own = self.gradients[self.border :] if network else self.gradients[: self.border]
        torch.linalg.vector_norm(own, out=self.norms[network])


def find_obstacle(alg: Any) -> str:
    """Return why the updates of an algorithm are not fused, "" where they can be."""
    spread = alg._raw_actor.distribution
    if not isinstance(spread, GaussianDistribution) or not hasattr(spread, "std_param"):
        return "the policy is no Gaussian with deviations of its own"
    for model in (alg._raw_actor, alg._raw_critic):
        layers = list(model.mlp)
        expected = [nn.Linear, nn.ELU] * (len(layers) // 2) + [nn.Linear]
        if [type(x) for x in layers] != expected or any(x.alpha != 1.0 for x in layers[1::2]):
            return "a network has other layers than linear ones and ELU"
    group = alg.optimizer.param_groups[0]
    if type(alg.optimizer) is not torch.optim.Adam or group["weight_decay"] or group["amsgrad"]:
        return "the optimizer is not Adam without decay"
    return "advantages are normalised for each minibatch" if alg.normalize_advantage_per_mini_batch else ""


def start_compiling(device: str) -> None:
    """Compile the kernels for a GPU in a thread of its own, beside those of an environment."""
    if torch.device(device).type == "cuda":
        name = str(wp.device_from_torch(torch.device(device)))
        thread = threading.Thread(target=lambda: wp.load_module(kernels, device=name), daemon=True)
        thread.start()
        _compiling.append(thread)


def round_up(count: int, size: int) -> int:
    """Return the least multiple of ``size`` that is not below ``count``."""
    return -(-count // size) * size


def start(kernel: Any, dim: Any, numbers: Sequence[Any], device: str, block: int = 256) -> None:
    """Launch a kernel on torch's current stream, in blocks of threads; tensors may be among its arguments."""
    arguments = [wp.from_torch(x, requires_grad=False) if isinstance(x, torch.Tensor) else x for x in numbers]
    held = wp.get_device(device)
    scope = wp.ScopedStream(stream(held), sync_enter=False) if held.is_cuda else wp.ScopedDevice(held)
    with scope:
        launch(kernel, dim if isinstance(dim, int) else tuple(dim), arguments, [], device=held, block_dim=block)


def pairs(x: torch.Tensor) -> Any:
    """Return the words of two numbers of a matrix, float32 or bfloat16."""
    if x.dtype == torch.float32:
        return wp.from_torch(x.view(torch.int64), dtype=wp.uint64, requires_grad=False)
    return wp.from_torch(x.view(torch.int32), dtype=wp.uint32, requires_grad=False)


def vectors(x: torch.Tensor) -> Any:
    """Return vectors of two numbers of an array."""
    return wp.from_torch(x.view(*x.shape[:-1], -1, 2), dtype=wp.vec2f, requires_grad=False)


def average(numbers: torch.Tensor) -> None:
    """Make numbers their means over all processes."""
    torch.distributed.all_reduce(numbers)
    numbers /= torch.distributed.get_world_size()


def multiply(a: torch.Tensor, b: torch.Tensor, out: torch.Tensor) -> None:
    """Set ``out``, float32, to the product of matrices."""
    if a.dtype == out.dtype:
        torch.mm(a, b, out=out)
    else:
        out.copy_(torch.mm(a, b))
