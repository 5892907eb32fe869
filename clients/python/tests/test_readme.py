"""The README's Python runs as it stands."""

import re
from pathlib import Path

import gymnasium

README = (Path(__file__).parents[1] / "README.md").read_text()

#: What stands for "..." where the reader drives.
EXPERT = """
for seed in range(10):
    observation, info = env.reset(seed=seed)
    over = False
    while not over:
        observation, _, terminated, truncated, _ = env.step(1)
        over = terminated or truncated
"""


def test_every_example(server, learner_address, capsys):
    examples = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(examples) == 6
    names = {"gymnasium": gymnasium}
    for example in examples:
        if "https://" in example:
            continue  # test_access.py has services over TLS
        code = example.replace("127.0.0.1:50051", server).replace("127.0.0.1:50052", learner_address)
        assert "127.0.0.1:5005" not in code
        exec(re.sub(r"^\.\.\.  #.*$", EXPERT, code, flags=re.MULTILINE), names)
    assert names["frame"].shape[2] == names["seen"].content.shape[2] == 3
    assert names["fit"].policy.shape == (36, 12)
    assert names["drive"].lengths.tolist() == [5] * 200
    assert "objective" in capsys.readouterr().out
