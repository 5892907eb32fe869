"""The wire: message classes and methods, built at run time from the shipped descriptor set.

No generated code is shipped, because protobuf refuses generated code that is newer than its runtime;
a `FileDescriptorSet` loads with every runtime from 4.25 on. The set is a copy of the one that the crate
`mazeway-proto` compiles (`cargo run -p mazeway-proto --example write_descriptors` renews it).

The classes live in a descriptor pool of their own, so they clash with nobody else's.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from types import SimpleNamespace
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

ENVIRONMENT_SERVICE = "mazeway.env.v1.EnvironmentService"
LEARNER_SERVICE = "mazeway.learner.v1.LearnerService"


@dataclass(frozen=True)
class Method:
    """One remote method: where it is and what it takes and gives."""

    path: str
    request: type[Any]
    response: type[Any]
    client_streaming: bool
    server_streaming: bool


def _status_file() -> descriptor_pb2.FileDescriptorProto:
    """Describes, wire-compatibly, the parts of google.rpc.Status and its details that errors carry."""
    field = descriptor_pb2.FieldDescriptorProto
    one, many = field.LABEL_OPTIONAL, field.LABEL_REPEATED
    file = descriptor_pb2.FileDescriptorProto(
        name="mazeway/python/status.proto", package="mazeway.python", syntax="proto3"
    )
    layout: dict[str, list[tuple[str, int, int, int, str]]] = {
        "Status": [
            ("code", 1, field.TYPE_INT32, one, ""),
            ("message", 2, field.TYPE_STRING, one, ""),
            ("details", 3, field.TYPE_MESSAGE, many, ".mazeway.python.Detail"),
        ],
        "Detail": [
            ("type_url", 1, field.TYPE_STRING, one, ""),
            ("value", 2, field.TYPE_BYTES, one, ""),
        ],
        "BadRequest": [("field_violations", 1, field.TYPE_MESSAGE, many, ".mazeway.python.FieldViolation")],
        "FieldViolation": [
            ("field", 1, field.TYPE_STRING, one, ""),
            ("description", 2, field.TYPE_STRING, one, ""),
        ],
        "PreconditionFailure": [
            ("violations", 1, field.TYPE_MESSAGE, many, ".mazeway.python.PreconditionViolation")
        ],
        "PreconditionViolation": [
            ("type", 1, field.TYPE_STRING, one, ""),
            ("subject", 2, field.TYPE_STRING, one, ""),
            ("description", 3, field.TYPE_STRING, one, ""),
        ],
    }
    for name, fields in layout.items():
        message = file.message_type.add(name=name)
        for field_name, number, kind, label, type_name in fields:
            message.field.add(
                name=field_name, number=number, type=kind, label=label, type_name=type_name or None
            )
    return file


def _load() -> tuple[dict[str, SimpleNamespace], dict[str, dict[str, Method]]]:
    data = resources.files(__name__).joinpath("mazeway.desc").read_bytes()
    files = [*descriptor_pb2.FileDescriptorSet.FromString(data).file, _status_file()]
    pool = descriptor_pool.DescriptorPool()
    packages: dict[str, SimpleNamespace] = {}
    for file in files:  # dependencies come first
        pool.AddSerializedFile(file.SerializeToString())
        package = packages.setdefault(file.package, SimpleNamespace())
        for message in file.message_type:
            descriptor = pool.FindMessageTypeByName(f"{file.package}.{message.name}")
            setattr(package, message.name, message_factory.GetMessageClass(descriptor))
        for enum in file.enum_type:
            values = {value.name: value.number for value in enum.value}
            setattr(package, enum.name, values)

    def message_class(name: str) -> type[Any]:
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(name.lstrip(".")))

    services = {
        f"{file.package}.{service.name}": {
            method.name: Method(
                path=f"/{file.package}.{service.name}/{method.name}",
                request=message_class(method.input_type),
                response=message_class(method.output_type),
                client_streaming=method.client_streaming,
                server_streaming=method.server_streaming,
            )
            for method in service.method
        }
        for file in files
        for service in file.service
    }
    return packages, services


_packages, services = _load()

#: Messages (classes) and enums (name to number) of each package.
env: Any = _packages["mazeway.env.v1"]
learner: Any = _packages["mazeway.learner.v1"]
status: Any = _packages["mazeway.python"]
well_known: Any = _packages["google.protobuf"]


def enum_name(enum: dict[str, int], prefix: str, number: int) -> str:
    """The name of an enum value as users write it: `BASIS_STATE_ACTION` is `"state-action"`."""
    for name, value in enum.items():
        if value == number:
            return name.removeprefix(prefix).lower().replace("_", "-")
    return str(number)


def enum_number(enum: dict[str, int], prefix: str, field: str, name: str) -> int:
    """The number of an enum value that a user named; raises ValueError with the known names."""
    key = prefix + name.upper().replace("-", "_").replace(" ", "_")
    if key in enum and enum[key] != 0:
        return enum[key]
    known = ", ".join(repr(enum_name(enum, prefix, n)) for n in enum.values() if n != 0)
    raise ValueError(f"{field}: expected one of {known}, got {name!r}")
