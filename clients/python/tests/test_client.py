"""The catalogue, models and roll-outs."""

import hashlib
import json
import struct

import numpy as np
import pytest
import scipy.sparse
from conftest import DATA

import mazeway


@pytest.fixture
def client(server):
    with mazeway.Client(server) as client:
        yield client


def test_catalogue(client):
    listed = {e.env_id: e for e in client.list_environments()}
    assert listed.keys() == {"Highway-v0", "Maze-v0"}
    maze, highway = listed["Maze-v0"], listed["Highway-v0"]
    assert (maze.n_states, maze.n_actions, maze.max_episode_steps) == (57, 4, 100)
    assert (highway.n_states, highway.n_actions, highway.max_episode_steps) == (36, 12, 200)
    assert maze.options["slip"][0] == 0.3
    assert {"layout", "rewards", "slip"} <= maze.options.keys()
    assert {"aggressive", "bad", "legal", "random"} <= highway.drivers.keys()
    assert {"aggressive", "bad", "legal"} <= set(highway.styles)
    assert all(e.description and all(e.infos.values()) for e in listed.values())


def test_maze_model_is_the_reference(client):
    model = client.model("mazeway/Maze-v0")
    reference = json.loads((DATA / "maze_model.json").read_text())
    expected = np.zeros((57, 4, 57))
    for state, action, following, probability in reference["transition"]:
        expected[state, action, following] = probability
    np.testing.assert_allclose(model.to_dense(), expected, atol=1e-12)
    np.testing.assert_allclose(model.initial_distribution, 1 / 57)
    assert not model.estimated
    assert model.visit_counts is None
    rows, columns, cells = model.grid
    assert (rows, columns, len(cells)) == (9, 9, 57)
    assert len(model.state_labels) == 57
    matrix = scipy.sparse.csr_array(model.csr, shape=(57 * 4, 57))
    np.testing.assert_allclose(matrix.sum(axis=1), 1)


def test_model_follows_options(client):
    sure = client.model("Maze-v0", slip=0.0)
    assert len(sure.probabilities) == 57 * 4
    assert sure.model_id != client.model("Maze-v0").model_id


def test_model_id_is_as_the_wire_lays_down(client):
    model = client.model("Maze-v0")
    digest = hashlib.sha256(b"mazeway-model-v1" + struct.pack("<II", 57, 4))
    for begin, end in zip(model.row_offsets[:-1], model.row_offsets[1:], strict=True):
        digest.update(struct.pack("<I", end - begin))
        for state, probability in zip(
            model.next_states[begin:end], model.probabilities[begin:end], strict=True
        ):
            digest.update(struct.pack("<Id", state, probability))
    assert model.model_id == digest.hexdigest()
    sent = next(iter(client.model_parts("Maze-v0", {}))).header.model_id
    assert model.model_id == sent


def test_highway_model_is_estimated(client):
    model = client.model("Highway-v0")
    assert model.estimated
    assert model.visit_counts.shape == (36 * 12,)
    assert model.visit_counts.sum() >= 2_000_000
    assert {"aggressive", "bad", "legal"} <= model.rewards.keys()
    twin = mazeway.Model.from_parts(model.parts())
    assert twin.model_id == model.model_id
    np.testing.assert_array_equal(twin.visit_counts, model.visit_counts)


def test_rollout_of_a_driver(client):
    out = client.rollout("Highway-v0", driver="legal", episodes=50, steps=20, seed=3)
    assert len(out) == 50
    assert out.lengths.tolist() == [20] * 50
    assert out.states.shape == out.actions.shape == out.rewards.shape == (1000,)
    assert 0 <= out.states.min() <= out.states.max() < 36
    assert {"collisions", "overtakes_left", "overtakes_right"} <= out.totals.keys()
    np.testing.assert_allclose(out.returns, out.rewards.reshape(50, 20).sum(axis=1), atol=1e-9)
    again = client.rollout("Highway-v0", driver="legal", episodes=50, steps=20, seed=3)
    np.testing.assert_array_equal(out.states, again.states)
    part = client.rollout("Highway-v0", driver="legal", episodes=2, steps=20, seed=3 + 7)
    np.testing.assert_array_equal(part.states, out.states[140:180])
    demonstrations = out.trajectories("legal")
    assert len(demonstrations) == 50
    assert demonstrations[7].seed == 10
    np.testing.assert_array_equal(demonstrations[7].states, part.states[:20])


def test_rollout_of_a_policy(client):
    east = np.zeros((57, 4))
    east[:, 2] = 1
    out = client.rollout("Maze-v0", policy=east, episodes=5, steps=30, seed=1)
    assert set(out.actions) == {2}
    assert out.source == "policy"
    totals = client.rollout("Maze-v0", policy=east, episodes=5, steps=30, seed=1, totals_only=True)
    assert totals.states.size == 0
    np.testing.assert_array_equal(totals.returns, out.returns)


def test_rollout_under_options(client):
    layout = [".....", ".#.#.", "....#"]
    out = client.rollout(
        "Maze-v0", episodes=3, steps=5, options={"layout": layout, "rewards": [[1, 2]], "slip": 0.0}
    )
    assert out.n_states == 12
    assert out.trajectories("x")[0].n_states == 12


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"env_id": "Nowhere-v0"}, mazeway.NotFoundError, "Nowhere-v0"),
        ({"driver": "drunk"}, mazeway.MazewayError, "drunk"),
        ({"episodes": 0}, mazeway.InvalidArgumentError, "episodes: expected at least 1"),
        ({"steps": 0}, mazeway.InvalidArgumentError, "steps: expected at least 1"),
        ({"seed": -1}, mazeway.InvalidArgumentError, "seed"),
        ({"policy": [0.5, 0.5]}, mazeway.InvalidArgumentError, "n_states, n_actions"),
        ({"policy": [[0.5, 0.5]]}, mazeway.InvalidArgumentError, "policy"),
        ({"policy": np.ones((57, 4))}, mazeway.InvalidArgumentError, "policy"),
        ({"policy": [[1.0]], "driver": "random"}, mazeway.InvalidArgumentError, "got both"),
        ({"options": {"slip": -1}}, mazeway.InvalidArgumentError, "slip"),
    ],
)
def test_wrong_rollouts(client, arguments, error, message):
    with pytest.raises(error) as caught:
        client.rollout(**{"env_id": "Maze-v0", "episodes": 1, "steps": 1, **arguments})
    assert message in f"{getattr(caught.value, 'field', '')}: {caught.value}"


def test_models_from_arrays():
    dense = np.random.default_rng(0).dirichlet(np.ones(5), size=(5, 3))
    dense[2, 1] = np.eye(5)[4]
    model = mazeway.Model.from_dense("x", dense)
    np.testing.assert_array_equal(model.to_dense(), dense)
    matrix = scipy.sparse.csr_array(dense.reshape(15, 5))
    assert mazeway.Model.from_csr("x", matrix, 3).model_id == model.model_id
    # Unsorted and repeated entries are what scipy allows and the wire does not.
    data = np.array([0.25, 0.5, 0.25, 1.0])
    untidy = (data, np.array([1, 0, 1, 1]), np.array([0, 3, 4]))
    np.testing.assert_array_equal(
        mazeway.Model.from_csr("x", untidy, 1).to_dense()[:, 0], [[0.5, 0.5], [0, 1]]
    )


@pytest.mark.parametrize(
    ("transition", "message"),
    [
        (np.ones((2, 2)), "expected shape"),
        (np.ones((2, 1, 2)), "sum to 1, got 2"),
        (np.zeros((2, 1, 2)), "no empty row"),
        (np.array([[[2.0, -1.0]], [[1.0, 0.0]]]), "at least 0"),
        (np.array([[[np.nan, 1.0]], [[1.0, 0.0]]]), "finite"),
    ],
)
def test_models_that_are_none(transition, message):
    with pytest.raises(mazeway.InvalidArgumentError, match=message):
        mazeway.Model.from_dense("x", transition)
