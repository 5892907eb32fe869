"""DeepMind's published compliance tests, unchanged, against each environment: one alone, with other options, and a batch."""

import numpy as np
from conftest import connect
from dm_env_rpc.v1 import compliance, dm_env_rpc_pb2, tensor_utils

WORLDS = {
    "Maze": {"env_id": "Maze-v0"},
    "SeededMaze": {"env_id": "Maze-v0", "seed": 7, "max_episode_steps": 5, "options.slip": 0.5},
    "Highway": {"env_id": "Highway-v0"},
    "KinematicsHighway": {"env_id": "Highway-v0", "options.observation": "kinematics"},
    "MazeBatch": {"env_id": "Maze-v0", "num_envs": 3},
    "HighwayBatch": {"env_id": "Highway-v0", "num_envs": 300, "options.observation": "kinematics"},
}


def pack(settings):
    return {name: tensor_utils.pack_tensor(value) for name, value in settings.items()}


class Connected:
    """A connection for each test case, in no world before and after a test; what the suites ask for beside that."""

    settings: dict

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls._connection = connect()

    @classmethod
    def tearDownClass(cls):
        cls._connection.close()
        super().tearDownClass()

    def tearDown(self):
        super().tearDown()
        self.connection.send(dm_env_rpc_pb2.LeaveWorldRequest())

    @property
    def connection(self):
        return self._connection

    def _create(self):
        request = dm_env_rpc_pb2.CreateWorldRequest(settings=pack(self.settings))
        return self._connection.send(request).world_name


class InWorld(Connected):
    def setUp(self):
        super().setUp()
        self._world_name = self._create()

    def tearDown(self):
        super().tearDown()
        self.connection.send(dm_env_rpc_pb2.DestroyWorldRequest(world_name=self._world_name))

    @property
    def world_name(self):
        return self._world_name


class CreateDestroyWorld(Connected):
    has_multiple_world_support = True

    @property
    def required_world_settings(self):
        return pack({"env_id": self.settings["env_id"]})

    @property
    def invalid_world_settings(self):
        return pack(
            {
                "no_such_setting": 1,
                "num_envs": -1,
                "seed": "seven",
                "max_episode_steps": 0.5,
                "lease_secs": np.nan,
                "options": "[]",
                "options.no_such_option": 1.0,
                "options.slip": 2.0,
                "options.density": 99.0,
            }
        )


class JoinLeaveWorld(InWorld):
    @property
    def invalid_join_settings(self):
        return pack({"no_such_setting": 1, "seed": -1, "env_id": "Maze-v0"})


class ResetWorld(InWorld):
    pass


class Reset(InWorld):
    def join_world(self):
        request = dm_env_rpc_pb2.JoinWorldRequest(world_name=self.world_name)
        return self.connection.send(request).specs


class Step(InWorld):
    def setUp(self):
        super().setUp()
        request = dm_env_rpc_pb2.JoinWorldRequest(world_name=self.world_name)
        self._specs = self.connection.send(request).specs

    @property
    def specs(self):
        return self._specs

    @property
    def required_actions(self):
        (spec,) = self._specs.actions.values()
        (uid,) = self._specs.actions
        return {uid: tensor_utils.pack_tensor(np.zeros(spec.shape, np.int32))}


def _classes():
    """One test case for each suite and world; made here, for a base class that is seen is a test case to pytest."""
    suites = {
        "CreateDestroyWorld": (CreateDestroyWorld, compliance.CreateDestroyWorld),
        "JoinLeaveWorld": (JoinLeaveWorld, compliance.JoinLeaveWorld),
        "Reset": (Reset, compliance.Reset),
        "ResetWorld": (ResetWorld, compliance.ResetWorld),
        "Step": (Step, compliance.Step),
    }
    for world, settings in WORLDS.items():
        for suite, bases in suites.items():
            name = f"Test{world}{suite}"
            yield name, type(name, bases, {"settings": settings, "__module__": __name__})


globals().update(_classes())
