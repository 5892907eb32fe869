"""The server's description of the protocol against the one that DeepMind's package was generated from."""

import os
from pathlib import Path

import pytest
from dm_env_rpc.v1 import dm_env_rpc_pb2
from dm_env_rpc.v1.extensions import properties_pb2
from google.protobuf import descriptor_pb2
from google.rpc import status_pb2


def _ours():
    described = descriptor_pb2.FileDescriptorSet()
    described.ParseFromString(Path(os.environ["MAZEWAY_DM_ENV_RPC_DESCRIPTORS"]).read_bytes())
    return {file.name: file for file in described.file}


def _fields(message, path):
    """Every field of a message and of those within it: what decides how bytes are read."""
    name = f"{path}.{message.name}"
    oneofs = [oneof.name for oneof in message.oneof_decl]
    for field in message.field:
        oneof = oneofs[field.oneof_index] if field.HasField("oneof_index") else None
        yield f"{name}.{field.name}", (field.number, field.type, field.label, field.type_name, oneof)
    reserved = [(span.start, span.end) for span in message.reserved_range]
    yield name, (message.options.map_entry, reserved, sorted(message.reserved_name))
    for nested in message.nested_type:
        yield from _fields(nested, name)
    for enum in message.enum_type:
        yield from _values(enum, name)


def _values(enum, path):
    yield f"{path}.{enum.name}", [(value.name, value.number) for value in enum.value]


def _service(service):
    for method in service.method:
        streams = (method.client_streaming, method.server_streaming)
        yield f"{service.name}/{method.name}", (method.input_type, method.output_type, *streams)


def _described(file):
    everything = {"package": file.package, "syntax": file.syntax, "imports": sorted(file.dependency)}
    for message in file.message_type:
        everything.update(_fields(message, file.package))
    for enum in file.enum_type:
        everything.update(_values(enum, file.package))
    for service in file.service:
        everything.update(_service(service))
    return everything


@pytest.mark.parametrize("module", [dm_env_rpc_pb2, properties_pb2, status_pb2], ids=lambda m: m.__name__)
def test_every_field_has_its_name_number_type_and_label(module):
    theirs = descriptor_pb2.FileDescriptorProto()
    module.DESCRIPTOR.CopyToProto(theirs)
    wanted, ours = _described(theirs), _described(_ours()[theirs.name])
    assert len(wanted) > 4
    assert ours == wanted
