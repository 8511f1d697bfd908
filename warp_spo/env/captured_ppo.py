"""rsl_rl's PPO whose rollouts and updates are CUDA graphs: :class:`CapturedPPO`.

Networks, storage, optimizer, configuration and checkpoints are those of rsl_rl and torch. Restated here, without
reads of the device, are the bodies of ``PPO.act``, ``PPO.update`` and ``EmpiricalNormalization.update``.
"""

from __future__ import annotations

import contextlib
import math
import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from torch import nn

from . import fused_update
from .compile.cuda_graphs import Captured
from .fused_update import FusedUpdate, average
from .not_finite import NotFiniteError, find_term
from .startup import plain_step

SLOWEST, FASTEST, FACTOR = 1e-5, 1e-2, 1.5  # learning rates, and what an adaptive one changes by, as in rsl_rl
ACTED = ("actions", "values", "actions_log_prob", "distribution_params", "hidden_states")  # what acting leaves


class CapturedPPO(PPO):
    """rsl_rl's PPO. On CUDA a rollout is one graph and an update another; on a CPU the same code is called.

    An update reads the device once. The learning rate lives on the device, where an adaptive one follows the KL
    divergence. Actor and critic run on two streams, or on a CPU in two threads. Several processes average gradients,
    KL divergences and normalisers inside of the update's graph.
    A learner that cannot be captured learns as in rsl_rl, and a warning says why.

    Attributes:
        obstacle: why it learns as in rsl_rl; "" where it does not. deviation: mean deviation of actions.
        log: what ``env.log()`` said after the rollout. meanwhile: called before an update waits for the device.
    """

    learning_rate: float
    _learning: Captured
    obstacle = ""
    captures = True  # False: the same without graphs
    fuses: bool | None = None  # whether updates take few kernels, :class:`FusedUpdate`; None: on CUDA, where they can

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self._on_gpu = torch.device(self.device).type == "cuda"
        self._refuse(find_obstacle(self))
        fuses = self._on_gpu if self.fuses is None else self.fuses
        fuses = fuses and not self.obstacle and not fused_update.find_obstacle(self)
        kind = torch.float32 if self._on_gpu or fuses else torch.float64  # the fused Adam of a GPU reads float32
        self._rate = torch.tensor(float(self.learning_rate), dtype=kind, device=self.device)
        self._kl = torch.zeros((), device=self.device)
        self._sums, self._found = (torch.zeros(n, dtype=torch.float64, device=self.device) for n in (3, 6))
        size = self.storage.num_envs * self.storage.num_transitions_per_env // self.num_mini_batches
        self._order = torch.zeros(self.num_mini_batches, size, dtype=torch.int64, device=self.device)
        self._side = torch.cuda.Stream(self.device) if self._on_gpu else None
        threads = not self._on_gpu and not self.is_multi_gpu and (os.cpu_count() or 1) > 1
        self._helper = ThreadPoolExecutor(1, "critic") if threads else None
        self._seen: Any = None  # observations from which a rollout starts
        self._env: Any = None
        self._log_names: list[str] = []
        self._fused: FusedUpdate | None = None
        self._can_fuse = fuses
        self._acting: Captured | None = None
        self._values: Callable[[], torch.Tensor] | None = None  # waits for those of the last actions
        self._kept: tuple[torch.Tensor, ...] = ()  # what was learned before this update
        self._kept_rate = 0.0
        self.deviation = torch.zeros(())
        self.meanwhile: Callable[[], None] = lambda: None
        self.log, self._log_values = dict[str, float](), torch.zeros(0, device=self.device)
        self._adopt()

    def compile(self, mode: str | None = None) -> None:
        """Compile actor and critic by torch, as rsl_rl does; None: do not."""
        super().compile(mode)
        if mode is not None:
            self._refuse("torch_compile_mode is given")

    def _refuse(self, why: str) -> None:
        """Learn as in rsl_rl from now on, for a reason."""
        if why and not self.obstacle and self._on_gpu:
            warnings.warn(f"train: learns without CUDA graphs, as in rsl_rl: {why}", stacklevel=4)
        self.obstacle = self.obstacle or why

    # -- collecting ------------------------------------------------------------------------------------------------
    def collect(self, env: Any, obs: Any) -> Any:
        """Take all steps of a rollout from these observations, compute returns, and return the last observations.

        They are overwritten by the next call. A graph holds the rollout where ``env.is_capturable`` says that it can.
        """
        with torch.inference_mode():
            if self._env is not env:
                self._env, self._seen = env, obs.clone()
                self._collecting = self._captured(self._roll_out, "the rollout", plain=0)
            elif obs is not self._seen:
                copy_into(self._seen, obs)
            if not self._collecting.is_graph and not getattr(env, "is_capturable", False):
                self._roll_out()
                return self._seen
            replays = self._collecting.is_graph
            if replays:
                env.take_written_values()
            self._collecting()
            if replays:
                env._steps += self.storage.num_transitions_per_env
        return self._seen

    @torch.inference_mode()
    def _roll_out(self) -> None:
        self.storage.clear()
        obs = self._seen
        for _ in range(self.storage.num_transitions_per_env):
            obs, rewards, dones, extras = self._env.step(self.act(obs))
            self.process_env_step(obs, rewards, dones, extras)
        self.compute_returns(obs)
        copy_into(self._seen, obs)
        found = self._env.log() if hasattr(self._env, "log") else {}
        self._log_names = list(found)
        if found:
            self._log_values = torch.stack([value.float() for value in found.values()])

    def act(self, obs: Any) -> torch.Tensor:
        """Sample actions and keep what the storage needs; on CUDA by a graph, outside of that of a rollout."""
        if self.obstacle:
            return super().act(obs)
        if not self._on_gpu or torch.cuda.is_current_stream_capturing():
            return self._act(obs)
        if self._acting is None:
            self._acted_on = obs.clone()
            self._acting = self._captured(self._act_for_graph, "the policy")
        copy_into(self._acted_on, obs)
        self._acting()
        for name, value in self._acted.items():
            setattr(self.transition, name, value)
        self._values = None
        self.transition.observations = obs
        return self.transition.actions  # type: ignore[return-value]

    def _act_for_graph(self) -> None:
        """Act on ``_acted_on`` and wait for the values; keep the tensors that replays of the graph fill anew."""
        self._act(self._acted_on)
        assert self._values is not None
        self.transition.values = self._values()
        self._acted = {name: getattr(self.transition, name) for name in ACTED}

    def _act(self, obs: Any) -> torch.Tensor:
        """Sample actions as ``PPO.act`` does; values come on the other stream, for which ``process_env_step`` waits."""
        kept = self.transition
        kept.hidden_states = (None, None)
        values = self._start_beside(torch.inference_mode()(lambda: self.critic(obs).detach()))
        kept.actions = self.actor(obs, stochastic_output=True).detach()
        kept.actions_log_prob = self.actor.get_output_log_prob(kept.actions).detach()
        kept.distribution_params = tuple(each.detach() for each in self.actor.output_distribution_params)
        kept.observations = obs
        self._values = values
        return kept.actions

    def process_env_step(self, obs: Any, rewards: Any, dones: Any, extras: Any) -> None:
        """Store a step, as in rsl_rl."""
        if self._values is not None:
            self.transition.values, self._values = self._values(), None
        super().process_env_step(obs, rewards, dones, extras)

    def compute_returns(self, obs: Any) -> None:
        """Compute returns and advantages, as in rsl_rl; advantages keep their place."""
        if self._fused is not None:
            return self._fused.compute_returns(self.critic(obs).detach())
        place = self.storage.advantages
        super().compute_returns(obs)
        self.storage.advantages = place.copy_(self.storage.advantages)

    # -- learning --------------------------------------------------------------------------------------------------
    def update(self) -> dict[str, float]:
        """Learn from the rollout in all epochs, and return the mean losses.

        Raises:
            NotFiniteError: the policy is not finite any more; it is again what it was before, and so is the optimizer.
        """
        self._kept_rate = self.learning_rate
        if self.obstacle:
            self._keep()
            losses, finite = super().update(), bool(self._is_finite())
            self.deviation = self.actor.output_std.detach().mean().cpu()
        else:
            self._order.copy_(torch.randperm(self._order.numel(), device=self.device).view_as(self._order))
            self._learning()
            self.storage.clear()
            size = len(self._found)
            held = torch.cat([self._found, self._log_values])
            self.meanwhile()
            numbers = held.tolist()  # the one wait for the device
            *means, rate, deviation, finite = numbers[:size]
            self.log = dict(zip(self._log_names, numbers[size:], strict=True))
            self.learning_rate, self.deviation = rate, torch.tensor(deviation)
            losses = dict(zip(("value", "surrogate", "entropy"), means, strict=True))
        if not finite:
            self._restore()
            raise NotFiniteError(find_term(self, self._restore))
        return losses

    def _learn(self) -> None:
        """Learn from the rollout in all epochs, in the order of ``_order``."""
        self._keep()
        self._sums.zero_()
        batches = [self._batch(index) for index in self._order]  # the same in all epochs, as in rsl_rl
        if self._fused is not None:
            self._fused.learn(batches)
        for _ in range(0 if self._fused is not None else self.num_learning_epochs):
            for batch in batches:
                self._differentiate(batch)
                if self.is_multi_gpu:
                    self.reduce_parameters()
                    average(self._kl)
                self._descend()
        for model in (self.actor, self.critic):
            if model.obs_normalization:
                renormalize(model, self.storage.observations)
        self._summarize()

    def _batch(self, index: torch.Tensor) -> RolloutStorage.Batch:
        """Return some samples of the rollout."""
        held = self.storage
        names = ("observations", "actions", "values", "advantages", "returns")
        return RolloutStorage.Batch(
            **{name: getattr(held, name).flatten(0, 1)[index] for name in names},
            old_actions_log_prob=held.actions_log_prob.flatten(0, 1)[index],
            old_distribution_params=tuple(each.flatten(0, 1)[index] for each in held.distribution_params or ()),
        )

    def _differentiate(self, batch: Any) -> None:
        """Compute the losses of a minibatch, their gradients, and the KL divergence."""
        self.optimizer.zero_grad()
        critic = self._start_beside(lambda: self._differentiate_critic(batch))
        actor, advantages = self.actor, torch.squeeze(batch.advantages)
        if self.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        actor.distribution.update(self._outputs(actor, batch.observations))  # type: ignore[union-attr]
        if self._adapts:
            with torch.no_grad():
                new = actor.output_distribution_params
                self._kl.copy_(actor.get_kl_divergence(batch.old_distribution_params, new).mean())
        old = torch.squeeze(batch.old_actions_log_prob)
        ratio = torch.exp(actor.get_output_log_prob(batch.actions) - old)
        clipped = torch.clamp(ratio, 1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
        entropy = actor.output_entropy.mean()
        (surrogate - self.entropy_coef * entropy).backward()
        self._sums += torch.stack([critic(), surrogate, entropy]).detach()

    def _differentiate_critic(self, batch: Any) -> torch.Tensor:
        """Compute the gradients of the value loss, and return it."""
        values = self._outputs(self.critic, batch.observations)
        losses = (values - batch.returns).pow(2)
        if self.use_clipped_value_loss:
            near = batch.values + (values - batch.values).clamp(-self.clip_param, self.clip_param)
            losses = torch.max(losses, (near - batch.returns).pow(2))
        value = losses.mean()
        (self.value_loss_coef * value).backward()
        return value

    def _outputs(self, model: MLPModel, observations: Any) -> torch.Tensor:
        """Return what a network makes of observations, without a sample that nobody reads."""
        kind = torch.device(self.device).type
        with torch.amp.autocast(kind, torch.bfloat16, enabled=self.use_mixed_precision):
            return model.mlp(model.get_latent(observations)).float()

    @torch.no_grad()
    def _descend(self) -> None:
        """Take a step of the optimizer along the gradients, by a rate that the KL divergence may have changed."""
        if self._adapts:
            kl, rate = self._kl, self._rate
            slower, faster = (rate / FACTOR).clamp(min=SLOWEST), (rate * FACTOR).clamp(max=FASTEST)
            grown = torch.where((kl < self.desired_kl / 2.0) & (kl > 0.0), faster, rate)
            rate.copy_(torch.where(kl > self.desired_kl * 2.0, slower, grown))
        for model in (self.actor, self.critic):
            nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self._step()

    @property
    def _adapts(self) -> bool:
        return self.desired_kl is not None and self.schedule == "adaptive"

    def _summarize(self) -> None:
        """Gather all that is read of an update: mean losses, the rate, the deviation, whether all is finite."""
        steps = self.num_learning_epochs * self.num_mini_batches
        deviation = self.actor.output_std.detach().mean() if self._fused is None else self._fused.deviation()
        finite = self._is_finite()
        self._found.copy_(torch.cat([self._sums / steps, torch.stack([self._rate, deviation, finite.to(self._rate)])]))

    # -- streams and graphs ----------------------------------------------------------------------------------------
    def _start_beside(self, work: Callable[[], torch.Tensor]) -> Callable[[], torch.Tensor]:
        """Do work on the other stream, or on a CPU in the other thread; return a function that waits for its result."""
        if self._helper is not None:
            return self._helper.submit(work).result
        with self._beside():
            found = work()

        def wait() -> torch.Tensor:
            self._join()
            return found

        return wait

    def _beside(self) -> Any:
        """Return a context in which work goes to the other stream, after what the current one has."""
        if self._side is None:
            return contextlib.nullcontext()
        self._side.wait_stream(torch.cuda.current_stream())
        return torch.cuda.stream(self._side)

    def _join(self) -> None:
        """Let the current stream wait for the other one."""
        if self._side is not None and not self.obstacle:
            torch.cuda.current_stream().wait_stream(self._side)

    def _captured(self, function: Any, what: str, plain: int = 1) -> Captured:
        return Captured(function, self.device, f"train: {what}", plain, self.captures)

    # -- the optimizer and checkpoints -----------------------------------------------------------------------------
    def _adopt(self) -> None:
        """Let the optimizer read its rate on the device, and forget graphs, which hold the places of its numbers."""
        if self.obstacle:
            return
        self.learning_rate = float(self.learning_rate)
        self._rate.fill_(self.learning_rate)
        self.optimizer._warned_capturable_if_run_uncaptured = True  # the first update is none
        for group in self.optimizer.param_groups:
            group.update(lr=self._rate, capturable=self._on_gpu, fused=self._on_gpu or None)
        for state in self.optimizer.state.values():
            state["step"] = state["step"].to(self.device)
        self._step = plain_step(self.optimizer)
        self._fused = FusedUpdate(self) if self._can_fuse else None
        self._learning = self._captured(self._learn, "the update")

    def broadcast_parameters(self) -> None:
        """Take over networks and normalisers of the first process, as in rsl_rl."""
        if self._fused is None:
            return super().broadcast_parameters()
        for tensor in (self._fused.weights, *self._normalizer_buffers()):  # parameters need not be contiguous
            torch.distributed.broadcast(tensor, src=0)

    def save(self) -> dict:
        """Return what a checkpoint holds, as rsl_rl writes and reads it."""
        saved = super().save()
        if not self.obstacle:
            found = saved["optimizer_state_dict"]
            for group in found["param_groups"]:
                group.update(lr=self.learning_rate, capturable=False, fused=None)
            found["state"] = {key: state | {"step": state["step"].cpu()} for key, state in found["state"].items()}
        return saved

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a checkpoint, of rsl_rl or of this class."""
        found = super().load(loaded_dict, load_cfg, strict)
        self._adopt()
        return found

    # -- numbers that are not finite -------------------------------------------------------------------------------
    def _learned_tensors(self) -> list[torch.Tensor]:
        """Return the tensors that learning changes: networks, normalisers, the optimizer's state."""
        if self._fused is not None:
            return [*self._fused.learned_tensors(), *self._normalizer_buffers()]
        networks = [*self._raw_actor.state_dict().values(), *self._raw_critic.state_dict().values()]
        state = [value for each in self.optimizer.state.values() for value in each.values()]
        return networks + [value for value in state if isinstance(value, torch.Tensor)]

    def _normalizer_buffers(self) -> list[torch.Tensor]:
        return [x for model in (self._raw_actor, self._raw_critic) for x in model.obs_normalizer.buffers()]

    @torch.no_grad()
    def _keep(self) -> None:
        """Copy what learning changes."""
        tensors = self._learned_tensors()
        if [x.shape for x in self._kept] != [x.shape for x in tensors]:
            self._kept = tuple(torch.empty_like(x) for x in tensors)
        torch._foreach_copy_(self._kept, tensors)

    @torch.no_grad()
    def _restore(self) -> None:
        """Undo an update: copy back networks, normalisers and optimizer from :meth:`_keep`, and the learning rate."""
        tensors = self._learned_tensors()
        torch._foreach_copy_(tensors[: len(self._kept)], self._kept)
        for tensor in tensors[len(self._kept) :]:  # Adam's, whose first step this was; a graph may hold their places
            tensor.zero_()
        self.learning_rate = self._kept_rate
        self._rate.fill_(self.learning_rate)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate if self.obstacle else self._rate

    def _is_finite(self) -> torch.Tensor:
        """Return whether networks and normalisers hold finite numbers alone, the same in all processes."""
        models = (self._raw_actor, self._raw_critic)
        numbers = [x.detach() for model in models for x in model.state_dict().values() if x.is_floating_point()]
        return torch.stack(torch._foreach_norm(numbers, math.inf)).isfinite().all()


def find_obstacle(alg: PPO) -> str:
    """Return why the updates of an algorithm of rsl_rl are not captured, "" where they can be."""
    models = {"actor": alg._raw_actor, "critic": alg._raw_critic}
    for name, model in models.items():
        if model.is_recurrent:
            return f"the {name} is recurrent"
        if type(model) is not MLPModel:
            return f"the {name} is a {type(model).__name__}, no MLPModel"
    if alg.rnd or alg.symmetry:
        return "rnd_cfg is given" if alg.rnd else "symmetry_cfg is given"
    if not isinstance(alg.optimizer, torch.optim.Adam | torch.optim.AdamW):
        return f"the optimizer is {type(alg.optimizer).__name__}, neither Adam nor AdamW"
    return ""


@torch.no_grad()
def renormalize(model: MLPModel, observations: Any) -> None:
    """Update the normaliser of a model in place by a rollout, as ``EmpiricalNormalization.update`` does."""
    held: Any = model.obs_normalizer
    if not held.training:
        return
    x = torch.cat([observations[name] for name in model.obs_groups], dim=-1).flatten(0, 1)
    mean, variance = x.mean(dim=0, keepdim=True), x.var(dim=0, unbiased=False, keepdim=True)
    count: Any = len(x)
    if torch.distributed.is_initialized():  # the mean of all first, then variances around it
        own, count = mean, torch.full_like(held.count, len(x))
        torch.distributed.all_reduce(count)
        mean = own * len(x)
        torch.distributed.all_reduce(mean)
        mean /= count
        variance = len(x) * (variance + (own - mean).square())
        torch.distributed.all_reduce(variance)
        variance /= count
    held.count += count
    rate, delta = count / held.count, mean - held._mean
    held._mean += rate * delta
    held._var += rate * (variance - held._var + delta * (mean - held._mean))
    held._std.copy_(held._var.sqrt())


def copy_into(held: Any, observations: Any) -> None:
    """Copy observations to the places of others, group by group."""
    for name, value in held.items():
        value.copy_(observations[name])
