"""What wire.py promises, and how it is told: the targets, each within one run, and the tables."""

LABELS = {
    "tcp": "TCP ping-pong, Python sockets",
    "gymnasium": "an empty Gymnasium environment, in process",
    "gymnasium.make": "the same in gymnasium.make's wrappers",
    "native": "mazeway, native, gymnasium.make",
    "native unwrapped": "mazeway, native, without wrappers",
    "native unix": "mazeway, native, Unix socket",
    "grpcio": "mazeway, grpcio, gymnasium.make",
    "grpcio unwrapped": "mazeway, grpcio, without wrappers",
    "grpcio tonic echo bidi": "grpcio bidi, bare, against a tonic echo",
    "grpcio echo bidi": "grpcio bidi, bare, against a grpcio echo",
    "grpcio echo unary": "grpcio unary, bare, against a grpcio echo",
    "dm_env_rpc": "dm_env_rpc's own server and client",
    "openenv websocket": "OpenEnv, WebSocket",
    "openenv http": "OpenEnv, HTTP",
    "remote-gym": "remote-gym, on dm_env_rpc's Python",
    "maze native 64": "mazeway maze, native, 64",
    "maze native 1024": "mazeway maze, native, 1,024",
    "maze native 16384": "mazeway maze, native, 16,384",
    "maze grpcio 1024": "mazeway maze, grpcio, 1,024",
    "highway native 1024": "mazeway highway, native, 1,024",
    "highway kinematics native 1024": "mazeway highway, native, 20 vehicles, kinematics, 1,024",
    "highway grpcio 1024": "mazeway highway, grpcio, 1,024",
    "envpool frozenlake 1024": "EnvPool FrozenLake, in process, 1,024",
    "envpool highway-fast 16": "EnvPool highway-fast, in process, 16",
    "envpool highway-fast 1024": "EnvPool highway-fast, in process, 1,024",
    "dm_env_rpc 1024": "dm_env_rpc's own, 1,024 as a tensor",
    "gymnasium one": "Gymnasium FrozenLake, in process, one",
    "gymnasium sync 64": "Gymnasium SyncVectorEnv FrozenLake, 64",
    "gymnasium async 64": "Gymnasium AsyncVectorEnv FrozenLake, 64",
    "highway-env one": "highway-env highway-fast-v0, in process",
}

MIB = 1024.0**2


def targets(modes, batches, rust):
    """Every target with what was measured; those whose figures were left out are left out."""
    found = []

    def add(what, value, bound, wanted, unit=""):
        """`value` is a function, for the figures that it needs may be missing."""
        try:
            measured = value()
        except KeyError:
            return
        met = measured >= wanted if bound == "at least" else measured <= wanted
        target = f"{bound} {wanted:g}{unit}"
        found.append({"what": what, "target": target, "measured": measured, "met": met})

    def over(name, other, figures):
        return lambda: figures[name] / figures[other]

    trips = {}
    for row in rust.get("round_trips", []):
        trips.setdefault(row["mode"], {})[row["name"]] = row["median"]
    for mode, rows in modes.items():
        at, ours = {name: row["median"] for name, row in rows.items()}, trips.get(mode, {})

        def unwrapped(floor, at=at):
            return lambda: (at["native"] - at["gymnasium.make"] + at["gymnasium"]) / floor()

        add(
            f"{mode}: Rust step / bare tonic stream",
            over("env_step_tcp", "tonic_bidi_tcp", ours),
            "at most",
            1.25,
            "x",
        )
        add(f"{mode}: Rust step / TCP in Rust", over("env_step_tcp", "raw_tcp", ours), "at most", 2.2, "x")
        wrappers = f"{mode}: native step less wrappers"
        add(f"{wrappers} / TCP in Python", unwrapped(lambda at=at: at["tcp"]), "at most", 2.5, "x")
        add(f"{wrappers} / TCP in Rust", unwrapped(lambda ours=ours: ours["raw_tcp"]), "at most", 2.5, "x")
        add(f"{mode}: dm_env_rpc / native step", over("dm_env_rpc", "native", at), "at least", 15, "x")
        openenv = min((name for name in at if name.startswith("openenv")), key=at.get, default="openenv")
        add(f"{mode}: OpenEnv's best / native step", over(openenv, "native", at), "at least", 8, "x")
        for echo in ("grpcio tonic echo bidi", "grpcio echo bidi"):
            what = f"{mode}: grpcio step / {LABELS[echo]}"
            add(what, over("grpcio unwrapped", echo, at), "at most", 1.15, "x")
    for mode, rows in batches.items():
        at = {name: row["median"] for name, row in rows.items()}
        fast = max(
            (name for name in at if name.startswith("envpool highway-fast")), key=at.get, default="envpool"
        )
        for name, least, peer, times in (
            ("maze native 1024", 10, "envpool frozenlake 1024", 10),
            ("highway native 1024", 1, fast, 40),
        ):
            what = f"{mode}: {LABELS[name]}"
            add(f"{what}: million steps a second", lambda at=at, name=name: at[name] / 1e6, "at least", least)
            if peer in at:
                add(f"{what} / {LABELS[peer]}", over(name, peer, at), "at least", times, "x")
    for row in rust.get("rollouts", []):
        what = f"{row['mode']}: roll-out, {row['env']}, {row['controller']}: million steps a second"
        add(what, lambda row=row: row["median"] / 1e6, "at least", row["promised"] / 1e6)
    for row in rust.get("memory", []):
        if row["limit"] is not None:
            size, unit = (MIB, " MiB") if row["limit"] >= MIB else (1, " bytes")
            what = " ".join(filter(None, ["memory:", row["name"], row["env"], f"of {row['count']:,}"]))
            add(what, lambda row=row, size=size: row["bytes"] / size, "at most", row["limit"] / size, unit)
    return found


def table(title, unit, rows, digits):
    """Lines of a table: label, median, lowest and highest."""
    width = max([len(title), *(len(label) for label, _ in rows)])
    lines = [f"{title:<{width}}  {unit:>12}  (lowest - highest)"]
    for label, row in rows:
        median, low, high = (f"{row[key]:,.{digits}f}" for key in ("median", "low", "high"))
        lines.append(f"{label:<{width}}  {median:>12}  ({low} - {high})")
    return lines


def report(result):
    """Lines of what was measured."""
    lines, rust = [], result["rust"]
    for mode, rows in result["round_trip_microseconds"].items():
        labelled = [(LABELS[name], row) for name, row in rows.items()]
        trips = [row for row in rust.get("round_trips", []) if row["mode"] == mode]
        labelled += [(f"Rust: {row['name']}, quartiles", row) for row in trips]
        lines += [*table(f"one step, {mode}", "microseconds", labelled, 1), ""]
    for mode, rows in result["steps_per_second"].items():
        million = [
            (LABELS[name], {key: value / 1e6 for key, value in row.items()}) for name, row in rows.items()
        ]
        lines += [*table(f"batches, {mode}", "million/s", million, 5), ""]
    width = max([6, *(len(row["what"]) for row in result["targets"])])
    lines.append(f"{'target':<{width}}  {'':<18} {'measured':>10}")
    for row in result["targets"]:
        word = "met" if row["met"] else "missed"
        lines.append(f"{row['what']:<{width}}  {row['target']:<18} {row['measured']:>10,.2f}  {word}")
    lines += [f"not measured: {LABELS[name]}: {why}" for name, why in result["failures"].items()]
    return lines
