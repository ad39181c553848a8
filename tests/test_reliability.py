"""Faults, hostile files and command lines: what trust/reliability.py counts, on tiny budgets, and a fuzzer over the arguments."""

import csv
import dataclasses
import string
import typing
from pathlib import Path

import pytest
import torch
import tyro
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import goal_mpc
import rl_mpc_deploy
import sac_her_branching
from experiments.trust import reliability

ROOT = Path(__file__).parent.parent

SCRIPTS = [goal_mpc, rl_mpc_deploy, sac_her_branching]
NUMBERS = st.one_of(
    st.integers(-3, 300).map(str), st.integers(-(10**30), 10**30).map(str), st.floats().map(str)
)
TEXT = st.one_of(
    st.text(string.printable, max_size=12),
    st.text(max_size=6),
    st.sampled_from(["", "cstr", "linear", "double_pendulum", "0"]),
)


def arguments(module):
    """Command lines of one to four of a script's arguments, whose values are often valid and often not."""

    def values(hint):
        choices = [
            choice
            for part in (hint, *typing.get_args(hint))
            for choice in typing.get_args(part)
            if isinstance(choice, str)
        ]
        return st.one_of(*([st.sampled_from(choices)] * 3 if choices else []), NUMBERS, TEXT)

    def option(field):
        name, hint = "--" + field.name.replace("_", "-"), hints[field.name]
        if hint is bool:
            return st.sampled_from([[name], ["--no-" + name[2:]], [name, "1"]])
        many = (
            st.lists(values(hint), max_size=3)
            if typing.get_origin(hint) is tuple
            else st.lists(values(hint), min_size=1, max_size=1)
        )
        return many.map(lambda words: [name, *words])

    hints = typing.get_type_hints(module.Args)
    options = [option(field) for field in dataclasses.fields(module.Args)]
    lines = st.lists(st.sampled_from(options).flatmap(lambda option: option), min_size=1, max_size=4)
    return lines.map(lambda line: [word for words in line for word in words])


@pytest.mark.parametrize("module", SCRIPTS, ids=lambda module: module.__name__)
@settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_command_line_is_accepted_or_refused_in_one_sentence(module, data, capsys):
    line = data.draw(arguments(module))
    try:
        module.check(tyro.cli(module.Args, args=line))
    except ValueError as refusal:
        assert str(refusal) and "\n" not in str(refusal), line
    except SystemExit as end:
        assert end.code in (0, 2), line
        assert end.code == 0 or capsys.readouterr().err.strip(), line


@settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_file_is_a_checkpoint_or_refused_in_one_sentence(data, checkpoint, tmp_path_factory):
    """Bytes of a checkpoint changed at random, and entries of any type in the place of its own."""
    path = tmp_path_factory.getbasetemp() / "fuzzed.pt"
    if data.draw(st.booleans()):
        content = bytearray(checkpoint.read_bytes())
        for at, value in data.draw(
            st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)), max_size=8)
        ):
            content[at] = value
        path.write_bytes(content[: data.draw(st.one_of(st.just(None), st.integers(0, len(content))))])
    else:
        plain = st.recursive(
            st.one_of(
                st.none(),
                st.booleans(),
                st.integers(),
                st.floats(),
                st.text(max_size=5),
                st.just(torch.zeros(2, 2)),
            ),
            lambda inner: st.one_of(
                st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)
            ),
            max_leaves=6,
        )
        content = torch.load(checkpoint, weights_only=True)
        where = data.draw(
            st.sampled_from(
                [content, content["network"], content["scaling"], content["actor"], content["critic"]]
            )
        )
        where[data.draw(st.sampled_from(sorted(where)))] = data.draw(plain)
        torch.save(content, path)
    for load in reliability.LOADERS:
        assert not reliability.verdict(load, path)["wrong"]


def test_code_in_a_checkpoint_is_not_run(capsys, checkpoint, tmp_path):
    data = torch.load(checkpoint, weights_only=True) | {"actor": reliability.Code()}
    torch.save(data, tmp_path / "evil.pt")
    for load in reliability.LOADERS:
        assert reliability.verdict(load, tmp_path / "evil.pt") == {"refused": 1}
    with pytest.raises(ValueError, match="resume.pt"):
        sac_her_branching.main(sac_her_branching.Args(resume=tmp_path / "evil.pt"))
    assert reliability.Code().__reduce__()[1][0] not in capsys.readouterr().out


@pytest.mark.parametrize("study", ["controllers", "training", "checkpoints", "deployments", "determinism"])
def test_nothing_goes_wrong(study, quick):
    """In the quick run as in the committed table, but for what the table says."""
    for folder in (quick, ROOT / "experiments"):
        for row in csv.DictReader(open(folder / f"results/reliability_{study}.csv")):
            if study == "controllers":
                assert row["wrong"] == "0" and row["refused"] == (
                    row["faults"] if row["case"] == "measurement not finite" else "0"
                ), row
                assert int(row["recovered"]) >= 0.95 * int(row["chances"]), row
            else:
                assert row["held"] == row["trials"], row
