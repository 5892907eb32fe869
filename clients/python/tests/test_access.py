"""TLS, certificates and tokens: a gate before the real services asks for them and passes on the rest."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import grpc
import gymnasium
import pytest
import trustme

import mazeway

TOKEN = "t0ken-of-a-robot"


class Gate(grpc.GenericRpcHandler):
    """Serves over TLS, and forwards the calls that bring the token."""

    def __init__(self, target, directory, *, token=None, client_ca=None):
        self._token = token
        options = [("grpc.max_receive_message_length", -1)]
        self._channel = grpc.insecure_channel(target, options)
        self._server = grpc.server(ThreadPoolExecutor(16), handlers=(self,), options=options)
        credentials = grpc.ssl_server_credentials(
            [((directory / "server-key.pem").read_bytes(), (directory / "server.pem").read_bytes())],
            client_ca.read_bytes() if client_ca else None,
            require_client_auth=client_ca is not None,
        )
        port = self._server.add_secure_port("127.0.0.1:0", credentials)
        self._server.start()
        self.address = f"https://127.0.0.1:{port}"

    def service(self, call):
        """Any method: on the wire, one message is a stream of one."""
        forward = self._channel.stream_stream(call.method)
        given = dict(call.invocation_metadata).get("authorization")

        def answer(requests, context):
            if self._token is not None and given != f"Bearer {self._token}":
                context.abort(grpc.StatusCode.UNAUTHENTICATED, "expected a token")
            context.send_initial_metadata(())  # as the services do: a stream is open before its first answer
            answers = forward(requests)
            context.add_callback(answers.cancel)
            try:
                yield from answers
            except grpc.RpcError as error:
                context.set_trailing_metadata(error.trailing_metadata())
                context.abort(error.code(), error.details())

        return grpc.stream_stream_rpc_method_handler(answer)

    def stop(self):
        self._server.stop(None).wait()
        self._channel.close()


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    """Files of an authority, of a server's certificate, and of a client's."""
    directory = tmp_path_factory.mktemp("authority")
    authority = trustme.CA()
    authority.cert_pem.write_to_path(directory / "ca.pem")
    for name, issued in (
        ("server", authority.issue_cert("localhost", "127.0.0.1")),
        ("robot", authority.issue_cert("robot@example.org", common_name="robot")),
    ):
        issued.private_key_pem.write_to_path(directory / f"{name}-key.pem")
        for link, pem in enumerate(issued.cert_chain_pems):
            pem.write_to_path(directory / f"{name}.pem", append=link > 0)
    return directory


@pytest.fixture(scope="module")
def guarded(authority, server):
    """Address of a server over TLS that asks for a token, and the token."""
    gate = Gate(server, authority, token=TOKEN)
    yield gate.address, TOKEN
    gate.stop()


def test_a_token_over_tls_opens_everything(guarded, authority):
    address, secret = guarded
    access = {"token": secret, "ca": authority / "ca.pem"}
    with mazeway.Client(address, **access) as client:
        assert client.model("Maze-v0").grid is not None
        assert len(client.rollout("Maze-v0", episodes=2, steps=3)) == 2
    env = gymnasium.make("mazeway/Maze-v0", address=address, **access)
    env.reset(seed=1)
    env.step(0)
    assert next(mazeway.watch(env)).step == 1
    copy = pickle.loads(pickle.dumps(env.unwrapped))
    copy.reset(seed=1)
    copy.close()
    envs = gymnasium.make_vec("mazeway/Maze-v0", num_envs=2, address=address, **access)
    envs.reset(seed=1)
    for shown in (env, env.spec, env.unwrapped.access, envs.spec, vars(env.unwrapped), vars(envs.unwrapped)):
        assert secret not in f"{shown} {shown!r}"
    env.close()
    envs.close()


def test_without_the_token_or_with_another_nothing_opens(guarded, authority):
    address, secret = guarded
    for wrong in (None, "mzw_nonsense", secret[:-1] + ("a" if secret[-1] != "a" else "b")):
        env = mazeway.MazewayEnv("Maze-v0", address, token=wrong, ca=authority / "ca.pem")
        with pytest.raises(mazeway.AccessDeniedError, match="MAZEWAY_TOKEN") as caught:
            env.reset()
        assert isinstance(caught.value, PermissionError)
        assert secret not in str(caught.value)


def test_the_environment_says_what_arguments_do_not(guarded, authority, tmp_path, monkeypatch):
    address, secret = guarded
    monkeypatch.setenv("MAZEWAY_TLS_CA", str(authority / "ca.pem"))
    monkeypatch.setenv("MAZEWAY_TOKEN", secret)
    with mazeway.Client(address) as client:
        assert client.list_environments()
    (tmp_path / "token").write_text(secret + "\n")
    monkeypatch.setenv("MAZEWAY_TOKEN", "")
    monkeypatch.setenv("MAZEWAY_TOKEN_FILE", str(tmp_path / "token"))
    with mazeway.Client(address) as client:
        assert client.list_environments()
    monkeypatch.setenv("MAZEWAY_TOKEN_FILE", str(tmp_path / "nowhere"))
    with pytest.raises(mazeway.InvalidArgumentError, match="MAZEWAY_TOKEN_FILE: cannot read"):
        mazeway.Client(address)


def test_an_authority_that_is_not_trusted_is_none(guarded, authority, tmp_path):
    address, secret = guarded
    trustme.CA().cert_pem.write_to_path(tmp_path / "other.pem")
    with (
        mazeway.Client(address, token=secret, ca=tmp_path / "other.pem", timeout=10) as client,
        pytest.raises(mazeway.ServerUnreachableError),
    ):
        client.list_environments()


def test_a_client_shows_its_certificate(authority, server):
    gate = Gate(server, authority, client_ca=authority / "ca.pem")
    address, ca = gate.address, authority / "ca.pem"
    own = {"cert": authority / "robot.pem", "key": authority / "robot-key.pem"}
    with mazeway.Client(address, ca=ca, **own) as client:
        assert client.list_environments()
    with mazeway.Client(address, ca=ca, timeout=10) as client, pytest.raises(mazeway.MazewayError):
        client.list_environments()
    gate.stop()


def test_a_recorder_and_a_learner_bring_their_token(guarded, authority, learner_address, which_client):
    address, secret = guarded
    own, style = "t0ken-of-a-teacher", f"guarded-{which_client}"
    gate = Gate(learner_address, authority, token=own)
    learner_address, ca = gate.address, authority / "ca.pem"
    env = gymnasium.make("mazeway/Maze-v0", address=address, token=secret, ca=ca, max_episode_steps=5)
    env = mazeway.Recorder(env, style, learner_address, token=own, ca=ca)
    env.reset(seed=1)
    for _ in range(5):
        env.step(2)
    assert own not in repr(env._saved_kwargs)
    env.close()
    with mazeway.Learner(learner_address, token=own, ca=ca) as learner:
        assert learner.count("Maze-v0", style) == 1
        assert learner.fit("Maze-v0", style, method="bc").policy.shape == (57, 4)
    gate.stop()


@pytest.mark.parametrize(
    ("address", "arguments", "field", "message"),
    [
        ("10.1.2.3:1", {"token": "t0ken"}, "token", "expected an https:// address"),
        ("robots.example:1", {"token": "t0ken"}, "token", "expected an https:// address"),
        ("127.0.0.1:1", {"token": "two words"}, "token", "expected visible ASCII"),
        ("127.0.0.1:1", {"token": " "}, "token", "expected visible ASCII"),
        ("127.0.0.1:1", {"ca": "ca.pem"}, "ca", "begins with https://"),
        ("https://127.0.0.1:1", {"ca": "/nowhere/ca.pem"}, "ca", "cannot read /nowhere/ca.pem"),
        ("https://127.0.0.1:1", {"cert": __file__}, "key", "expected a file beside cert"),
        ("https://127.0.0.1:1", {"key": __file__}, "cert", "expected a file beside key"),
    ],
)
def test_what_does_not_go_together_is_refused(address, arguments, field, message):
    with pytest.raises(mazeway.InvalidArgumentError, match=message) as caught:
        mazeway.Client(address, **arguments)
    assert caught.value.field == field
    assert "t0ken" not in str(caught.value)


def test_a_token_may_go_to_this_machine_or_where_it_was_asked_for():
    for address, insecure in (("127.0.0.1:1", False), ("localhost:1", False), ("10.1.2.3:1", True)):
        mazeway.Client(address, token="t0ken", insecure=insecure).close()
