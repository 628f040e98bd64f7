"""COLMAP's part, through pycolmap: features, matches, cameras; quiet, repeatable, and able to stop and go on.

Features and matches lie in a database, to which a second run adds what the first did not get to. [Schönberger
and Frahm 2016, "Structure-from-Motion Revisited"]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.progress import progress_bar, with_bar

SEED = 0
"""Seed of all random numbers; with it, a second run gives the same result."""
WORKING_SIZE = 1600
"""Longest side, pixels, of the pictures in which features are found. Pictures of twice that size take four
times as long and give hardly more features that several views share."""
MOST_FEATURES = 3000
"""Most features of a picture; matching time grows with their square. With 3,000, two cores match about 30
pairs a second."""
POLL = 0.25
"""Seconds between two updates of the progress bar."""
PICTURES_AT_ONCE, PAIRS_AT_ONCE = 8, 200
"""Pictures or pairs that one call of COLMAP processes; the progress bar moves after each call."""
SMALLEST_MODEL = 3
"""Least number of pictures in a model; COLMAP's default of 10 would refuse small sets."""
MOST_MODELS = 5
"""Largest number of separate groups of pictures that are reconstructed, for the message that counts them."""

Result = TypeVar("Result")
Item = TypeVar("Item")


def load() -> Any:
    """pycolmap, silent; raises InputError that says how to install it."""
    try:
        import pycolmap
    except ImportError:
        raise InputError('capture: pycolmap is not installed; pip install "mi_refgs[capture]"') from None
    return pycolmap


def installed() -> bool:
    """Whether pycolmap can be imported."""
    try:
        load()
    except InputError:
        return False
    return True


@contextmanager
def quiet() -> Iterator[None]:
    """COLMAP's log goes nowhere: what it says is said here in other words, errors as exceptions."""
    pycolmap = load()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def progress(what: str) -> Callable[[Sequence[Item]], Iterable[Item]]:
    """A progress bar around the items of a loop."""

    return lambda items: with_bar(items, what)


def _run(call: Callable[[Any], Result], poll: Callable[[], None] = lambda: None) -> Result:
    """Run `call(cancellation token)` in a thread, so that Ctrl-C stops it; `poll` is called now and then."""
    pycolmap = load()
    token = pycolmap.CancellationToken()
    with quiet(), ThreadPoolExecutor(1) as pool:
        pycolmap.set_random_seed(SEED)
        future = pool.submit(call, token)
        try:
            while not wait([future], timeout=POLL).done:
                poll()
        except BaseException:
            token.cancel()
            raise
        return future.result()


def _in_parts(
    items: Sequence[Item], size: int, what: str, work: Callable[[Sequence[Item], Any], None]
) -> None:
    """`work(items, token)` for so many items at a time, with a progress bar.

    The database is left alone meanwhile: a second reader, with locks of its own, can spoil the file.
    """
    with progress_bar(len(items), what) as shown:
        for start in range(0, len(items), size):
            part = items[start : start + size]
            _run(lambda token, part=part: work(part, token))  # type: ignore[misc]
            shown.update(len(part))


def begin(database: Path, folder: Path, groups: Sequence[tuple[Sequence[str], str, Sequence[float]]]) -> None:
    """A new database with the pictures of some cameras: (names in `folder`, model, parameters or none)."""
    pycolmap = load()
    temporary = database.with_name(f".{database.name}.tmp")
    for stale in (temporary, *(temporary.with_name(temporary.name + ending) for ending in ("-wal", "-shm"))):
        stale.unlink(missing_ok=True)
    with quiet():
        pycolmap.Database.open(temporary).close()
        for names, model, parameters in groups:
            options = pycolmap.ImageReaderOptions()
            options.camera_model = model
            options.camera_params = ",".join(f"{value:.17g}" for value in parameters)
            pycolmap.import_images(temporary, folder, pycolmap.CameraMode.SINGLE, list(names), options)
    temporary.replace(database)


def extract(database: Path, folder: Path, names: Sequence[str]) -> None:
    """SIFT features of the pictures that have none yet."""
    pycolmap = load()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.max_num_features = MOST_FEATURES
    mode, reader = pycolmap.CameraMode.AUTO, pycolmap.ImageReaderOptions()

    def work(part: Sequence[str], token: Any) -> None:
        pycolmap.extract_features(
            database, folder, list(part), mode, reader, options, pycolmap.Device.cpu, cancellation_token=token
        )

    _in_parts(names, PICTURES_AT_ONCE, "features", work)


def match(database: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Matches, verified by a two-view geometry, of the pairs of pictures that have none yet."""
    pycolmap = load()
    listed = database.with_suffix(".pairs.txt")
    matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    matching.use_gpu = False
    pairing.match_list_path = listed
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED

    def work(part: Sequence[tuple[str, str]], token: Any) -> None:
        listed.write_text("".join(f"{first} {second}\n" for first, second in part))
        pycolmap.match_image_pairs(
            database, matching, pairing, verification, pycolmap.Device.cpu, cancellation_token=token
        )

    _in_parts(pairs, PAIRS_AT_ONCE, "matches", work)


def features(database: Path) -> dict[str, np.ndarray]:
    """Descriptors (N, 128) uint8 of each picture's features by name."""
    pycolmap = load()
    with quiet(), closing(pycolmap.Database.open(database)) as opened:
        return {
            image.name: np.asarray(opened.read_descriptors(image.image_id).data).reshape(-1, 128)
            if opened.exists_descriptors(image.image_id)
            else np.empty((0, 128), dtype=np.uint8)
            for image in opened.read_all_images()
        }


def verified(database: Path) -> list[tuple[str, str, int, bool]]:
    """Pairs that a two-view geometry explains: names, matches, and whether a turn or a plane explains
    them."""
    pycolmap = load()
    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = {kinds.PANORAMIC, kinds.PLANAR, kinds.PLANAR_OR_PANORAMIC}
    with quiet(), closing(pycolmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        ids, geometries = opened.read_two_view_geometries()
        found = []
        for pair, geometry in zip(ids, geometries, strict=True):
            if len(geometry.inlier_matches):
                first, second = pycolmap.pair_id_to_image_pair(pair)
                found.append(
                    (names[first], names[second], len(geometry.inlier_matches), geometry.config in flat)
                )
        return found


def options_of_mapping() -> Any:
    """What mapping and triangulation share."""
    pycolmap = load()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.min_model_size = SMALLEST_MODEL
    options.max_num_models = MOST_MODELS
    return options


def reconstruct(database: Path, folder: Path, output: Path, count: int) -> list[Any]:
    """Cameras and points of each connected group of pictures, the largest group first.

    An empty list where no two pictures are fit to begin with.
    """
    pycolmap = load()
    output.mkdir(parents=True, exist_ok=True)
    placed: list[None] = []

    def one_more() -> None:
        placed.append(None)

    def call(token: Any) -> Any:
        return pycolmap.incremental_mapping(
            database,
            folder,
            output,
            options_of_mapping(),
            initial_image_pair_callback=one_more,
            next_image_callback=one_more,
            cancellation_token=token,
        )

    with progress_bar(count, "cameras") as shown:

        def show() -> None:
            shown.update(max(0, min(len(placed), count) - shown.n))

        models = _run(call, show)
        show()
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def triangulate(database: Path, folder: Path, output: Path, poses: dict[str, np.ndarray]) -> Any:
    """The reconstruction of the database's pictures with known cameras; `poses`: camera from world (3, 4)."""
    pycolmap = load()
    model = pycolmap.Reconstruction()
    with quiet(), closing(pycolmap.Database.open(database)) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            known = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(known, pycolmap.Rigid3d(poses[image.name]))
    options = options_of_mapping()
    return _run(
        lambda token: pycolmap.triangulate_points(
            model, database, folder, output, True, options, cancellation_token=token
        )
    )
