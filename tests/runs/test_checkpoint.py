"""Checkpoints: what is cut off, flipped or wrong is found, named and passed over; no run is lost unasked."""

import io
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.errors import UnknownNameError
from mi_refgs.io.ownership import MARK
from mi_refgs.runs import checkpoint
from mi_refgs.runs.run import Run
from tests.helpers import refused

State = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def state(finished: Path) -> State:
    """What a fit of the full method has saved."""
    newest = checkpoint.decode(Run(finished).checkpoints()[-1].read_bytes())
    assert "mesh/faces" in newest and "params/light" in newest
    return newest


def test_what_is_written_is_read(state: State) -> None:
    read = checkpoint.decode(checkpoint.encode(state))
    assert read.keys() == state.keys()
    for name, values in state.items():
        assert read[name].dtype == values.dtype and np.array_equal(read[name], values), name
    with np.load(io.BytesIO(checkpoint.encode(state))) as archive:  # by anyone who has NumPy
        assert {*archive.files} == {*state, "version"}


def test_cut_anywhere_is_found(state: State) -> None:
    data = checkpoint.encode(state)
    lengths = {0, 1, 22, len(data) - 1, *np.linspace(0, len(data) - 1, 300).astype(int).tolist()}
    for length in lengths:
        with pytest.raises(checkpoint.DamagedError):
            checkpoint.decode(data[:length])


def test_flipped_bit_anywhere_is_found(state: State, rng: np.random.Generator) -> None:
    data = bytearray(checkpoint.encode(state))
    ends = [*range(200), *range(len(data) - 200, len(data))]
    for place in (*ends, *rng.integers(len(data), size=300).tolist()):
        bit = 1 << int(rng.integers(8))
        data[place] ^= bit
        with pytest.raises(checkpoint.DamagedError):
            checkpoint.decode(bytes(data))
        data[place] ^= bit
    checkpoint.decode(bytes(data))


def test_version_and_unknown_attribute_are_named(state: State, monkeypatch: pytest.MonkeyPatch) -> None:
    odd = checkpoint.encode(state | {"params/colour": state["params/albedo"]})
    with pytest.raises(UnknownNameError, match="surfels: 'colour' is unknown"):
        checkpoint.decode(odd)
    monkeypatch.setattr(checkpoint, "VERSION", 0)
    data = checkpoint.encode(state)
    monkeypatch.undo()
    with pytest.raises(checkpoint.DamagedError, match="version 0"):
        checkpoint.decode(data)


def damage(path: Path, how: str) -> None:
    data = path.read_bytes()
    half = len(data) // 2
    flipped = data[:half] + bytes([data[half] ^ 16]) + data[half + 1 :]
    path.write_bytes({"empty": b"", "cut": data[:-1000], "half": data[:half], "flipped": flipped}[how])


@pytest.mark.parametrize("how", ["empty", "cut", "half", "flipped"])
def test_resume_goes_on_from_checkpoint_before_and_says_so(
    how: str, run: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, newest = Run(run).checkpoints()
    damage(newest, how)
    assert main(["train", str(data), "-o", str(run), "--resume"]) == 0
    said = capsys.readouterr().err
    assert f"{newest}: damaged" in said and "resumed at iteration 3 of 6" in said
    assert checkpoint.decode(newest.read_bytes())["iteration"] == 6
    assert Run(run).checkpoints() == [before, newest]


def test_export_keeps_the_fit_whose_checkpoint_is_damaged(run: Path) -> None:
    before = [(run / name).read_bytes() for name in ("surfels.ply", "model.json")]
    damage(Run(run).checkpoints()[-1], "half")
    assert main(["export", str(run)]) == 0
    assert [(run / name).read_bytes() for name in ("surfels.ply", "model.json")] == before


def test_no_fit_begins_anew_over_damaged_checkpoints(run: Path, data: Path) -> None:
    for path in Run(run).checkpoints():
        damage(path, "half")
    words = "0000006.npz: damaged", "begin anew", run / "checkpoints"
    refused(["train", data, "-o", run, "--resume"], *words)
    assert len(Run(run).checkpoints()) == 2
    # The artefacts are of iteration 6 and need no checkpoint.
    assert main(["eval", str(run)]) == 0


def test_resume_clears_what_killed_process_left(run: Path, data: Path) -> None:
    log = run / "metrics.jsonl"
    whole = log.read_bytes()
    log.write_bytes(whole + b'{"iteration": 6, "loss": 0.\x00\xff{')
    for name in ("checkpoints/.0000009.npz.0123456789ab.tmp.npz", ".surfels.ply.0123456789ab.tmp.ply"):
        (run / name).write_bytes(b"half")
    (run / ".notes").write_text("mine")
    copy = run / "checkpoints" / "0000006 copy.npz"
    copy.write_bytes(b"mine")
    Run(run).checkpoints()[-1].unlink()
    assert main(["train", str(data), "-o", str(run), "--resume"]) == 0
    assert {path.name for path in run.rglob(".*")} == {MARK, ".notes"} and copy.exists()
    lines = log.read_bytes().splitlines()
    assert lines[:1] == whole.splitlines()[:1] and len(lines) == 3


def test_method_that_changed_since_is_refused(run: Path, data: Path) -> None:
    config = run / "config.toml"
    for old, new, at in (
        ("height = 8", "height = 16", "light"),
        ("radiance_sh = 1", "radiance_sh = 2", "sh"),
    ):
        text = config.read_text()
        assert old in text
        config.write_text(text.replace(old, new))
        refused(["train", data, "-o", run, "--resume"], run, at, "resume with the method")
        config.write_text(text)
