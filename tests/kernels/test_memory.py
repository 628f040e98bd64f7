"""What is computed says beforehand how much memory it needs, and is refused where there is less."""

from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import psutil
import pytest

from mi_refgs.errors import InputError
from mi_refgs.io.files import resource_dir
from mi_refgs.kernels import memory
from tests.helpers import refused
from tests.scenes.integrator import scene, sensor
from tests.scenes.tiny import train_command

BOUNDED = {
    "train": ["train", "DATA"],
    "eval": ["eval", "RUN"],
    "render": ["render", "RUN", "-o", "OUT/a.exr"],
    "relight": ["relight", "RUN", "--envmap", "RUN/envmap.exr", "-o", "OUT"],
    "edit": ["edit", "RUN", "--where", "metallic > 0.5", "--set", "roughness=0.3", "-o", "OUT"],
    "export": ["export", "RUN", "--to", "exr", "-o", "OUT"],
    "import": ["import", "RUN/surfels.ply", "-o", "OUT"],
    "view": ["view", "RUN", "--port", "0"],
    "dataset": ["dataset", "SCENE", "-o", "OUT"],
}


@pytest.mark.parametrize("name", BOUNDED)
def test_a_command_without_memory_is_refused_in_one_sentence(
    name: str, data: Path, finished: Path, method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "available", lambda: 0.0)
    monkeypatch.setattr(memory, "resident", lambda: 1e3)
    places = {"DATA": data, "RUN": finished, "OUT": tmp_path, "SCENE": resource_dir("scenes") / "diffuse.xml"}
    arguments = train_command(data, tmp_path / "run", method) if name == "train" else BOUNDED[name]
    for word, place in places.items():
        arguments = [text.replace(word, str(place)) for text in arguments]
    refused(arguments, "GB of memory", "1e-06 GB are available; ")


def test_images_are_refused_and_rendered_again_where_they_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the plugin too, with derivatives sooner, in one sentence with the numbers and a remedy."""
    of = scene(sensor(film={"width": 600, "height": 500}))
    monkeypatch.setattr(memory, "resident", lambda: 0.1e9)
    monkeypatch.setattr(memory, "available", lambda: 0.2e9)
    sentence = "image: 600 × 500 pixels of 24 surfels: needs 0.44 GB of memory, 0.3 GB are available; ask for"
    refused(lambda: mi.render(of, spp=1).numpy(), sentence)
    monkeypatch.setattr(memory, "available", lambda: 0.37e9)
    params = mi.traverse(of)
    dr.enable_grad(params["integrator.albedo"])
    image = mi.render(of, params, spp=1)
    assert image.shape == (500, 600, 3)
    sentence = "24 surfels: needs 0.5 GB of memory, 0.47 GB are available"
    refused(lambda: dr.backward(dr.sum(image, axis=None)), sentence)


def test_the_least_of_machine_and_control_groups_is_available(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Limits of the group and of its parents; page cache is available; nothing is no limit."""
    proc, groups = tmp_path / "proc", tmp_path / "cgroup"
    monkeypatch.setattr(memory, "PROC", proc)
    monkeypatch.setattr(memory, "CGROUPS", groups)
    assert memory.available() > 1e8 and memory.resident() > 1e6  # without a file of groups, the machine's
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=5000 * 1024))
    (proc / "self").mkdir(parents=True)

    def group(place: str, limit: str, used: int, cache: int) -> None:
        folder = groups / place
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(limit)
        (folder / "memory.current").write_text(str(used))
        (folder / "memory.stat").write_text(f"anon 5\ninactive_file {cache}\n")

    (proc / "self/cgroup").write_text("0::/a/b\n")
    assert memory.available() == 5000 * 1024
    group("a/b", "max", 10, 0)
    group("a", "4000000", 1000, 200)
    assert memory.available() == 4_000_000 - 1000 + 200
    group("a/b", "3000000", 1000, 0)
    assert memory.available() == 3_000_000 - 1000


def test_memory_of_the_process_counts_as_available(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "resident", lambda: 2e9)
    monkeypatch.setattr(memory, "available", lambda: 1e9)
    memory.require(3e9, "a", "b")
    with pytest.raises(InputError, match=r"^a: needs 3\.1 GB of memory, 3 GB are available; b$"):
        memory.require(3.1e9, "a", "b")
