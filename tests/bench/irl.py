"""Times of the learner beside its nearest peers on one maze and one set of demonstrations, in one run.

    python3 tests/bench/irl.py [--rounds N] [--peers numpy,econirl,imitation] [--json]

Makes virtual environments of its own (kept in the cache directory, `--venv`), installs the peers from PyPI in pinned
versions, builds the learner's example `fit_times` in release mode, and runs them in turn, round by round, each pinned to one
thread of linear algebra. The maze and the demonstrations are those under `tests/data`. Peers are charged their processor
time without imports, the learner the time on the clock (for gradients processor time as well); those that take minutes run once. Peers:

- numpy: the likelihood fit of `em-tied` as one would write it in numpy (dense transitions, soft values by Newton's method,
  the exact gradient, scipy's L-BFGS-B), below in this file;
- econirl: its maximum causal entropy estimator with one feature a state, without standard errors;
- imitation (not by default: torch brings several gigabytes): its tabular MCE IRL with a linear reward.

Peers differ in what they maximise and in when they stop, so the share of optimal actions stands beside the time.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import venv
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = REPOSITORY / "tests" / "data"
PACKAGES = {
    "numpy": ["numpy==2.4.6", "scipy==1.17.1"],
    "econirl": ["econirl==0.1.1", "jax==0.10.2", "jaxlib==0.10.2", "numpy==2.4.6", "scipy==1.17.1"],
    "imitation": ["imitation==1.0.1", "seals==0.2.1"],
}
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PLATFORMS": "cpu",
}
DISCOUNT = 0.9
N_ACTIONS = 4


def load():
    """Transitions (states, actions, states), demonstrations, and the optimal actions of each state."""
    import numpy as np

    model = json.loads((DATA / "maze_model.json").read_text())
    demonstrations = json.loads((DATA / "maze_demonstrations.json").read_text())
    n_states = len(model["optimal_actions"])
    transition = np.zeros((n_states, N_ACTIONS, n_states))
    for state, action, following, p in model["transition"]:
        transition[int(state), int(action), int(following)] = p
    return (
        transition,
        np.array(demonstrations["states"]),
        np.array(demonstrations["actions"]),
        model["optimal_actions"],
    )


def agreement(action_values, optimal):
    """Share of states whose greedy action is optimal, ties split evenly."""
    total = 0.0
    for values, best in zip(action_values, optimal, strict=True):
        greedy = [a for a, q in enumerate(values) if q >= max(values) - 1e-9]
        total += sum(a in best for a in greedy) / len(greedy)
    return total / len(optimal)


def counts(states, actions, n_states):
    import numpy as np

    table = np.zeros((n_states, N_ACTIONS))
    np.add.at(table, (states.ravel(), actions.ravel()), 1.0)
    return table


class Likelihood:
    """log-likelihood of the soft-optimal policy and its exact gradient, dense."""

    def __init__(self, transition, table, discount):
        self.transition, self.counts, self.discount = transition, table, discount
        self.flow = discount * transition.reshape(-1, transition.shape[2]).T @ table.ravel() - table.sum(1)
        self.values = transition.sum((1, 2)) * 0.0

    def __call__(self, weights):
        import numpy as np

        identity = np.eye(len(weights))
        while True:
            q = weights[:, None] + self.discount * self.transition @ self.values
            top = q.max(1)
            updated = top + np.log(np.exp(q - top[:, None]).sum(1))
            policy = np.exp(q - updated[:, None])
            error = updated - self.values
            resolvent = identity - self.discount * np.einsum("sa,sat->st", policy, self.transition)
            if np.abs(error).max() <= 1e-12 * (1 + np.abs(self.values).max()):
                break
            self.values = self.values + np.linalg.solve(resolvent, error)
        v = np.linalg.solve(resolvent.T, self.flow)
        self.q = q
        return (self.counts * (q - updated[:, None])).sum(), (self.counts + policy * v[:, None]).sum(1)


def run_numpy(transition, states, actions, optimal):
    import numpy as np
    from scipy.optimize import minimize

    begun = time.process_time()
    likelihood = Likelihood(transition, counts(states, actions, len(transition)), DISCOUNT)

    def objective(weights):
        value, gradient = likelihood(weights)
        return weights.sum() - value, 1.0 - gradient

    bounds = [(0, None)] * len(transition)
    minimize(
        objective,
        np.zeros(len(transition)),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 500},
    )
    return time.process_time() - begun, agreement(likelihood.q, optimal)


def run_gradient(_transition, _states, _actions, _optimal):
    """One dense gradient at 2,500 states, from a warm start."""
    import numpy as np

    side = 50
    n = side * side
    transition = np.zeros((n, N_ACTIONS, n))
    for state in range(n):
        row, column = divmod(state, side)
        to = [
            state - side if row > 0 else state,
            state + side if row + 1 < side else state,
            state + 1 if column + 1 < side else state,
            state - 1 if column > 0 else state,
        ]
        for action in range(N_ACTIONS):
            for direction, following in enumerate(to):
                transition[state, action, following] += 0.775 if direction == action else 0.075
    random = np.random.default_rng(0)
    likelihood = Likelihood(transition, random.integers(0, 5, (n, N_ACTIONS)).astype(float), DISCOUNT)
    weights = random.random(n)
    likelihood(weights)
    begun = time.process_time()
    likelihood(weights + 0.05 * (random.random(n) - 0.5))
    return time.process_time() - begun, None


def run_econirl(transition, states, actions, optimal):
    import jax.numpy as jnp
    import numpy as np
    from econirl.core.types import DDCProblem, Panel, Trajectory
    from econirl.estimation.mce_irl import MCEIRLEstimator
    from econirl.preferences.linear import LinearUtility

    n = len(transition)
    trajectories = [
        Trajectory(jnp.array(s[:-1]), jnp.array(a[:-1]), jnp.array(s[1:]))
        for s, a in zip(states, actions, strict=True)
    ]
    features = jnp.array(np.repeat(np.eye(n)[:, None, :], N_ACTIONS, axis=1))
    problem = DDCProblem(num_states=n, num_actions=N_ACTIONS, discount_factor=DISCOUNT)
    estimator = MCEIRLEstimator(compute_se=False)
    begun = time.process_time()
    found = estimator.estimate(
        Panel(trajectories), LinearUtility(features), problem, jnp.array(transition.transpose(1, 0, 2))
    )
    secs = time.process_time() - begun
    return secs, agreement(np.asarray(found.policy).tolist(), optimal)


def run_imitation(transition, states, actions, optimal):
    import numpy as np
    import torch
    from imitation.algorithms.mce_irl import MCEIRL, mce_partition_fh
    from imitation.rewards.reward_nets import BasicRewardNet
    from seals.base_envs import TabularModelPOMDP

    torch.set_num_threads(1)
    n, horizon = len(transition), states.shape[1]
    env = TabularModelPOMDP(
        transition_matrix=transition,
        observation_matrix=np.eye(n, dtype=np.float32),
        reward_matrix=np.zeros(n),
        horizon=horizon,
        initial_state_dist=np.full(n, 1 / n),
    )
    net = BasicRewardNet(
        env.observation_space,
        env.action_space,
        hid_sizes=[],
        use_action=False,
        use_done=False,
        use_next_state=False,
    )
    occupancy = np.zeros(n)
    for k in range(horizon):
        np.add.at(occupancy, states[:, k], DISCOUNT**k / len(states))
    rng = np.random.default_rng(0)
    learner = MCEIRL(
        occupancy, env, net, rng=rng, discount=DISCOUNT, optimizer_kwargs={"lr": 0.1}, log_interval=None
    )
    begun = time.process_time()
    learner.train(max_iter=500)
    secs = time.process_time() - begun
    with torch.no_grad():
        reward = net(torch.eye(n), None, None, None).numpy().astype(float)
    _, _, policy = mce_partition_fh(env, reward=reward, discount=DISCOUNT)
    return secs, agreement(policy[0].tolist(), optimal)


RUNNERS = {
    "numpy": run_numpy,
    "numpy gradient": run_gradient,
    "econirl": run_econirl,
    "imitation": run_imitation,
}


# Minutes: one round says enough.
SLOW = ["econirl", "imitation"]


def environment(directory, packages):
    """The interpreter of a virtual environment that holds the packages."""
    python = directory / "bin" / "python"
    marker = directory / "installed.json"
    if not (marker.is_file() and json.loads(marker.read_text()) == packages):
        print(f"installing {', '.join(packages)}", file=sys.stderr)
        venv.create(directory, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
        marker.write_text(json.dumps(packages))
    return python


def peer(python, name):
    command = [python, __file__, "--run", name]
    output = subprocess.run(
        command, env=os.environ | ONE_THREAD, check=True, capture_output=True, text=True
    ).stdout
    return json.loads(output.splitlines()[-1])


def ours(binary, rounds):
    return json.loads(
        subprocess.run([binary, str(rounds)], check=True, capture_output=True, text=True).stdout
    )


def build():
    command = "cargo build --release -p mazeway-learner --no-default-features --example fit_times --message-format json"
    lines = subprocess.run(command.split(), cwd=REPOSITORY, check=True, capture_output=True, text=True).stdout
    found = (json.loads(line) for line in lines.splitlines())
    return next(m["executable"] for m in found if m.get("executable") and m["target"]["name"] == "fit_times")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--rounds", type=int, default=5, help="rounds, of which medians are shown [default: 5]"
    )
    parser.add_argument(
        "--peers", default="numpy,econirl", help="of numpy, econirl, imitation [default: numpy,econirl]"
    )
    parser.add_argument("--venv", type=Path, default=Path.home() / ".cache" / "mazeway" / "bench-irl")
    parser.add_argument("--binary", help="the built example fit_times [default: built in release mode]")
    parser.add_argument("--json", action="store_true", help="print one object")
    parser.add_argument("--run", choices=RUNNERS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        secs, share = RUNNERS[arguments.run](*load())
        print(json.dumps({"secs": secs, "agreement": share}))
        return

    chosen = arguments.peers.split(",")
    if unknown := [name for name in chosen if name not in PACKAGES]:
        parser.error(f"--peers: expected some of {', '.join(PACKAGES)}, got {', '.join(unknown)}")
    pythons = {name: environment(arguments.venv / name, PACKAGES[name]) for name in chosen}
    tasks = {task: pythons[task.split()[0]] for task in RUNNERS if task.split()[0] in pythons}
    binary = arguments.binary or build()
    mine, theirs = [], {task: [] for task in tasks}
    for turn in range(max(arguments.rounds, 1)):
        mine.append(ours(binary, 15))
        for task, python in tasks.items():
            if turn == 0 or task not in SLOW:
                theirs[task].append(peer(python, task))

    def median(pick):
        return statistics.median(statistics.median(pick(run)) for run in mine)

    fits = {method: median(lambda run, m=method: run["fits"][m]) for method in mine[0]["fits"]}
    gradients = {n: median(lambda run, n=n: run["gradients"][n]["warm"]) for n in mine[0]["gradients"]}
    rows = []
    feature_matching = "mce" if "mce" in fits else "em-tied"
    against = {"numpy": "em-tied", "econirl": feature_matching, "imitation": feature_matching}
    for name in tasks:
        secs = statistics.median(run["secs"] for run in theirs[name])
        method = against.get(name)
        own = gradients["2500"] if method is None else fits[method]
        rows.append(
            {
                "task": "gradient, 2,500 states" if method is None else f"fit, {method}",
                "peer": name.split()[0],
                "peer_secs": secs,
                "peer_agreement": theirs[name][-1]["agreement"],
                "mazeway_secs": own,
                "mazeway_agreement": None if method is None else mine[-1]["agreement"][method],
                "ratio": secs / own,
            }
        )
    if arguments.json:
        print(json.dumps({"rounds": arguments.rounds, "fits": fits, "gradients": gradients, "peers": rows}))
        return
    for method, secs in fits.items():
        print(f"mazeway {method:<28} {1e3 * secs:10.3f} ms   agreement {mine[-1]['agreement'][method]:.3f}")
    for n, secs in gradients.items():
        print(f"mazeway gradient at {int(n):>7,} states     {1e3 * secs:10.3f} ms")
    print()
    print(
        f"{'task':<26} {'peer':<10} {'peer, ms':>12} {'agreement':>10} {'mazeway, ms':>12} {'agreement':>10} {'ratio':>8}"
    )
    for row in rows:
        shares = ["" if row[k] is None else f"{row[k]:.3f}" for k in ("peer_agreement", "mazeway_agreement")]
        print(
            f"{row['task']:<26} {row['peer']:<10} {1e3 * row['peer_secs']:12.2f} {shares[0]:>10} "
            f"{1e3 * row['mazeway_secs']:12.3f} {shares[1]:>10} {row['ratio']:8.0f}"
        )


if __name__ == "__main__":
    main()
