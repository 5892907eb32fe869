"""What type checkers are told: the marker, and a stub that says what the native module has."""

import ast
import inspect
from pathlib import Path

import pytest

import mazeway


def functions(nodes):
    """Parameters of each function by its name, without `self`."""
    return {
        node.name: [
            argument.arg for argument in (*node.args.args, *node.args.kwonlyargs) if argument.arg != "self"
        ]
        for node in nodes
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
    }


def parameters(function):
    return [name for name in inspect.signature(function).parameters if name not in ("self", "/")]


def test_the_package_says_that_it_is_typed():
    assert Path(mazeway.__file__).with_name("py.typed").is_file()


def test_the_stub_is_the_native_module():
    native = pytest.importorskip("mazeway._native")
    nodes = ast.parse(Path(native.__file__).with_name("_native.pyi").read_text()).body
    classes = {node.name: functions(node.body) for node in nodes if isinstance(node, ast.ClassDef)}
    told = {**classes, **functions(nodes)}
    told |= {node.target.id: None for node in nodes if isinstance(node, ast.AnnAssign)}
    assert {name for name in dir(native) if not name.startswith("_")} == set(told)
    for name, methods in classes.items():
        there = {key: value for key, value in vars(getattr(native, name)).items() if not key.startswith("_")}
        assert set(there) == set(methods), name
        for method, arguments in methods.items():
            if callable(there[method]):
                assert parameters(there[method]) == arguments, f"{name}.{method}"
    for name, arguments in functions(nodes).items():
        assert parameters(getattr(native, name)) == arguments, name
