"""Connections to a running server, whose address stands in MAZEWAY_ADDRESS."""

import os

import grpc
import pytest
from dm_env_rpc.v1 import connection as dm_env_rpc_connection


def connect():
    """A connection as a user of dm_env_rpc opens it."""
    return dm_env_rpc_connection.create_secure_channel_and_connect(
        os.environ["MAZEWAY_ADDRESS"], grpc.local_channel_credentials(), timeout=60
    )


@pytest.fixture
def connection():
    """One connection."""
    with connect() as opened:
        yield opened
