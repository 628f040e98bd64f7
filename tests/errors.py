"""The errors that a user meets, one command per kind; `python -m tests.errors` writes them into errors.txt.

Read the file as a list: each sentence names the file, the field and the remedy."""

import contextlib
import io
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from mi_refgs.cli import main
from mi_refgs.cli.command import METHODS
from tests.scenes.tiny import train_command, write_data, write_method

LIST = Path(__file__).with_name("errors.txt")

COMMANDS = """
trian
train no_data -o out
train no_image -o out --method tiny.toml
train data -o out --method nothing
train data -o out --method wrong.toml
train data -o out --for nothing
train data -o out --for relighting --method no_pbr
train data -o out --preset fast
train data -o out --set loss.ssim
train data -o out --set loss.sim=1
train data -o out --set loss.ssim=much
train data -o out --threads 0
train data -o out --mitsuba-variant scalar_rgb
train data -o file/out --method tiny.toml
train data -o run --method tiny.toml
train data -o run --resume --preset standard
train data -o new --resume
doctor --masks
train data -o out --plugin no.py
train data -o out --plugin wrong.py
dataset no.xml -o out
dataset scene.xml -o out --size x
capture nothing -o out
eval data
eval no_record
render no.xml -o x.exr
render broken.xml -o x.exr
render nan -o x.exr
render no_light -o x.exr
render run -o x.bmp
render run -o file/x.png
render run -o x.png --aov albedo
render run -o x.exr --samples 0
render run -o x.exr --sensor 7
render run -o x.exr --aov colour
render run -o x.exr --camera empty.json
relight run --envmap no.exr -o out
relight run --envmap text.exr -o out
relight run --envmap light.exr --exposure 99 -o out
edit run -o run --set roughness=1
edit run -o out --set roughness
edit run -o out --set nothing=1
edit run -o out --where x<{ --set roughness=1
export run --to nothing -o x
export run --to 3dgs-ply
export run --degree 1
export damaged
export run -o file/out
import no.ply -o out
import text.exr -o out
import nan/surfels.ply -o out --preset quick
view run --port 70000
view run --host 192.0.2.1
compare -o out --methods tiny.toml
compare -o out
compare data -o out
compare data -o out --methods nothing
""".strip().splitlines()


def prepare() -> None:
    """Make what the commands read, in the current folder."""
    from mi_refgs.io.exr import write_exr

    here = Path()
    data, method = write_data(here / "made").rename("data"), write_method(here)
    method.rename("tiny.toml")
    (here / "wrong.toml").write_text((here / "tiny.toml").read_text().replace("degree", "degrees"))
    assert main(train_command(data, here / "run", here / "tiny.toml")) == 0
    for name in ("no_record", "nan", "no_light", "damaged"):
        shutil.copytree("run", name)
    shutil.copytree("data", "no_image")
    (here / "no_image/train/r_1.png").unlink()
    (here / "no_record/dataset.json").unlink()
    for name in ("nan", "no_light"):
        shutil.rmtree(here / name / "checkpoints")
    header, end, body = (here / "nan/surfels.ply").read_bytes().partition(b"end_header\n")
    (here / "nan/surfels.ply").write_bytes(header + end + np.float32(np.nan).tobytes() + body[4:])
    (here / "no_light/envmap.exr").unlink()
    for path in here.glob("damaged/checkpoints/*.npz"):
        path.write_bytes(b"damaged")
    for name in ("file", "text.exr"):
        (here / name).write_text("text")
    (here / "broken.xml").write_text("<scene")
    (here / "scene.xml").write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    (here / "wrong.py").write_text("import mi_refgs\nmi_refgs.register_loss(len)\n")
    (here / "empty.json").write_text("{}")
    write_exr("light.exr", np.ones((4, 8, 3), np.float32))


def errors() -> str:
    """Return each command and what it prints last on standard error."""
    lines = []
    for command in COMMANDS:
        told = io.StringIO()
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
            code = main(command.split())
        assert code == 2 and not Path("out").exists(), command
        lines += [f"$ refgs {command}", told.getvalue().strip().splitlines()[-1], ""]
    return "\n".join(lines)


def listed() -> str:
    """Return what belongs into LIST."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            prepare()
        found = errors().replace(os.path.realpath(folder), "HERE")
    found = found.replace(METHODS, "NAMES OF METHODS")
    return found.replace(f"give 1 to {4 * (os.cpu_count() or 1)}", "give 1 to 4 × CORES")


if __name__ == "__main__":
    LIST.write_text(listed(), encoding="utf-8")
