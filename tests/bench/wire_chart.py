"""The README's chart of speed, from what wire.py measured."""

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt

OURS, THEIRS, FLOOR = "#c8402f", "#8a93a3", "#c9ced6"
STEP = [
    ("tcp", "TCP ping-pong (floor)", FLOOR),
    ("native", "mazeway, native", OURS),
    ("grpcio", "mazeway, grpcio", OURS),
    ("grpcio tonic echo bidi", "bare grpcio, Rust echo", FLOOR),
    ("openenv websocket", "OpenEnv, WebSocket", THEIRS),
    ("dm_env_rpc", "dm_env_rpc", THEIRS),
    ("openenv http", "OpenEnv, HTTP", THEIRS),
    ("remote-gym", "remote-gym", THEIRS),
]
BATCH = [
    ("maze native 1024", "mazeway maze, remote, 1,024", OURS),
    ("highway native 1024", "mazeway highway, remote, 1,024", OURS),
    ("envpool frozenlake 1024", "EnvPool FrozenLake, local, 1,024", THEIRS),
    ("dm_env_rpc 1024", "dm_env_rpc, remote, 1,024", THEIRS),
    ("gymnasium one", "Gymnasium FrozenLake, local, 1", THEIRS),
    ("gymnasium sync 64", "Gymnasium Sync, local, 64", THEIRS),
    ("envpool highway-fast 1024", "EnvPool highway-fast, local, 1,024", THEIRS),
    ("gymnasium async 64", "Gymnasium Async, local, 64", THEIRS),
    ("highway-env one", "highway-env, local, 1", THEIRS),
]


def words(value):
    if value >= 1e6:
        return f"{value / 1e6:.1f} million"
    return f"{value:,.0f}"


def bars(axes, rows, figures, title, limits, *, falling):
    """Bars on a logarithmic scale, the best on top."""
    rows = [row for row in rows if row[0] in figures]
    rows.sort(key=lambda row: figures[row[0]]["median"], reverse=falling)
    values = [figures[name]["median"] for name, _, _ in rows]
    places = range(len(rows))
    axes.barh(places, values, color=[colour for _, _, colour in rows], height=0.7)
    axes.set_yticks(list(places), [label for _, label, _ in rows])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlim(*limits)
    axes.set_title(title, loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    for place, value in zip(places, values, strict=True):
        axes.annotate(words(value), (value, place), xytext=(4, 0), textcoords="offset points", va="center")


def draw(result, path):
    plt.rcParams.update({"font.size": 9, "svg.hashsalt": "mazeway", "svg.fonttype": "none"})
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
    pinned = result["round_trip_microseconds"]["pinned"]
    bars(left, STEP, pinned, "one env.step from Python, microseconds, one core", (1, 1e4), falling=False)
    batches = result["steps_per_second"]["idle"]
    title = f"steps a second, {result['cores']} cores"
    bars(right, BATCH, batches, title, (10, 1e9), falling=True)
    figure.savefig(path, metadata={"Date": None} if path.endswith("svg") else None, dpi=150)
