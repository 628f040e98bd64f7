"""COLMAP through pycolmap: features, pairs, matches, reconstruction and lens; silent and deterministic.
Features and matches are in a database, to which a second run adds. [Schönberger and Frahm 2016]"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import combinations, count as counter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.cluster.vq import kmeans2, vq

from mi_refgs.data.colmap_model import MODELS, read_cameras, read_images, read_points
from mi_refgs.errors import InputError, require_package
from mi_refgs.io.progress import progress_bar

SEED = 0  # seed of all random numbers; a second run gives the same result
WORKING_SIZE = 1600  # longest side of the images, pixels; twice takes four times as long for few matches more
IMAGES_AT_ONCE, PAIRS_AT_ONCE = 8, 200  # per call of COLMAP; the progress bar moves after each
EXHAUSTIVE = 150  # largest number of images for which every pair is matched: 11,175 pairs take some minutes
IN_ORDER = 8  # images before and after each, by name, with which it is matched in larger sets: a walk
WORDS, WORD_SAMPLES, WORD_ROUNDS = 64, 400, 12  # words, features per image to find them, k-means rounds

Reconstruction = Any  # pycolmap.Reconstruction
Result = TypeVar("Result")
T = TypeVar("T")


class _Pycolmap:
    """The package, imported when something of it is read; raises InputError that says how to install it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(require_package("pycolmap", "capture", "capture"), name)


pycolmap: Any = _Pycolmap()


@contextmanager
def quiet() -> Iterator[None]:
    """Silence COLMAP's log; errors are exceptions."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def write(model: Reconstruction, folder: Path) -> None:
    """Write COLMAP's binary files; raises InputError if they are not whole, of which COLMAP says nothing."""
    model.write_binary(folder)
    try:
        for file, read in (("cameras", read_cameras), ("images", read_images), ("points3D", read_points)):
            read(folder / f"{file}.bin")
    except InputError as error:
        raise InputError("not written whole", folder, "output", "free some space, and repeat") from error


def _run(call: Callable[[Any], Result]) -> Result:
    """Run `call(cancellation token)` in a thread, so that Ctrl-C stops it."""
    token = pycolmap.CancellationToken()
    with quiet(), ThreadPoolExecutor(1) as pool:
        pycolmap.set_random_seed(SEED)
        future = pool.submit(call, token)
        try:
            while not wait([future], timeout=0.25).done:  # seconds between two looks for Ctrl-C
                pass
        except BaseException:
            token.cancel()
            raise
        return future.result()


def _in_parts(items: Sequence[T], size: int, what: str, work: Callable[[Sequence[T], Any], None]) -> None:
    """Call `work(items, token)` for `size` items at a time; nothing else may open the database meanwhile."""
    with progress_bar(len(items), what) as shown:
        for start in range(0, len(items), size):
            part = items[start : start + size]
            _run(lambda token, part=part: work(part, token))  # type: ignore[misc]
            shown.update(len(part))


def begin(database: Path, folder: Path, groups: Sequence[tuple[Sequence[str], str, Sequence[float]]]) -> None:
    """Create a database with the images of cameras: (names in `folder`, model, parameters or none) each."""
    temporary = database.parent / "begun.db"
    for stale in database.parent.glob("begun.db*"):
        stale.unlink()
    with quiet():
        pycolmap.Database.open(temporary).close()
        for names, model, parameters in groups:
            options = pycolmap.ImageReaderOptions()
            options.camera_model = model
            options.camera_params = ",".join(f"{value:.17g}" for value in parameters)
            pycolmap.import_images(temporary, folder, pycolmap.CameraMode.SINGLE, list(names), options)
    temporary.replace(database)


def extract(database: Path, folder: Path, names: Sequence[str]) -> None:
    """Detect SIFT features of the images that have none yet."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.max_num_features = 3000  # two cores match 30 pairs a second; time grows with its square
    settings = (pycolmap.CameraMode.AUTO, pycolmap.ImageReaderOptions(), options, pycolmap.Device.cpu)

    def work(part: Sequence[str], token: Any) -> None:
        pycolmap.extract_features(database, folder, list(part), *settings, cancellation_token=token)

    _in_parts(names, IMAGES_AT_ONCE, "features", work)


def match(database: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Match the pairs of images that have no matches yet, verified by a two-view geometry."""
    listed = database.with_suffix(".pairs.txt")
    matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    matching.use_gpu = False
    pairing.match_list_path = listed
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    settings = (matching, pairing, verification, pycolmap.Device.cpu)

    def work(part: Sequence[tuple[str, str]], token: Any) -> None:
        listed.write_text("".join(f"{first} {second}\n" for first, second in part))
        pycolmap.match_image_pairs(database, *settings, cancellation_token=token)

    _in_parts(pairs, PAIRS_AT_ONCE, "matches", work)


def features(database: Path) -> dict[str, np.ndarray]:
    """Feature descriptors (N, 128) uint8 of each image by name."""
    with quiet(), closing(pycolmap.Database.open(database)) as opened:
        return {
            image.name: np.asarray(opened.read_descriptors(image.image_id).data).reshape(-1, 128)
            if opened.exists_descriptors(image.image_id)
            else np.empty((0, 128), dtype=np.uint8)
            for image in opened.read_all_images()
        }


def reconstruct(database: Path, folder: Path, output: Path, count: int) -> list[Any]:
    """Reconstruct each connected group of images: pycolmap.Reconstructions, the largest first."""
    output.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.min_model_size = 3  # the default of 10 would refuse small sets
    options.max_num_models = 5  # separate groups of images, which a message counts
    placed = counter(1)
    with progress_bar(count, "cameras") as shown:

        def one_more() -> None:
            shown.update(next(placed) <= count)

        given = (database, folder, output, options)
        calls = {"initial_image_pair_callback": one_more, "next_image_callback": one_more}
        models = _run(lambda token: pycolmap.incremental_mapping(*given, **calls, cancellation_token=token))
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def pairs_to_match(features: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Choose pairs of images by name; `features`: descriptors (N, D) by name."""
    names = sorted(features)
    if len(names) <= EXHAUSTIVE:
        return list(combinations(names, 2))
    near = {(i, j) for i in range(len(names)) for j in range(i + 1, min(i + 1 + IN_ORDER, len(names)))}
    likeness = image_similarity([features[name] for name in names])
    np.fill_diagonal(likeness, -np.inf)
    for i, best in enumerate(np.argsort(-likeness, axis=1, kind="stable")[:, :20]):  # they close loops
        near |= {(min(i, int(j)), max(i, int(j))) for j in best}
    return [(names[i], names[j]) for i, j in sorted(near)]


def image_similarity(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Cosine similarities (N, N) of VLAD vectors, signed square roots. [Arandjelović and Zisserman 2013]"""
    rng = np.random.default_rng(0)
    drawn = [rng.permutation(d)[:WORD_SAMPLES].astype(np.float32) for d in descriptors]
    everything = np.concatenate(drawn)
    if len(everything) < WORDS:
        return np.zeros((len(descriptors),) * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty word is harmless
        words, _ = kmeans2(everything, WORDS, iter=WORD_ROUNDS, minit="points", rng=rng)
    sums = np.zeros((len(descriptors), WORDS, everything.shape[1]))
    for total, sample in zip(sums, drawn, strict=True):
        if len(sample):
            word, _ = vq(sample, words)
            np.add.at(total, word, sample - words[word])
    sums /= np.maximum(np.linalg.norm(sums, axis=2, keepdims=True), 1e-12)  # intra-normalisation
    vectors = sums.reshape(len(sums), -1)
    vectors = np.sign(vectors) * np.sqrt(abs(vectors))
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return vectors @ vectors.T


@dataclass(frozen=True, eq=False)
class Solved:
    """Registered images and triangulated points, in COLMAP's frame or a similar one."""

    names: list[str]  # of the images
    rotation: np.ndarray  # (V, 3, 3) camera from world; +x right, +y down, +z forward
    origin: np.ndarray  # (V, 3) world
    half_angle: np.ndarray  # (V,) radians, half the smaller field of view
    points: np.ndarray  # (P, 3) world
    length: np.ndarray  # (P,) track length

    @property
    def axis(self) -> np.ndarray:
        """Viewing directions (V, 3)."""
        return self.rotation[:, 2]

    @classmethod
    def of(cls, model: Reconstruction) -> "Solved":
        images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
        poses = [image.cam_from_world() for image in images]
        cameras = [model.cameras[image.camera_id] for image in images]
        reach = [min(c.width / c.focal_length_x, c.height / c.focal_length_y) / 2 for c in cameras]
        points = list(model.points3D.values())
        return cls(
            [image.name for image in images],
            np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3),
            np.array([image.projection_center() for image in images]).reshape(-1, 3),
            np.arctan(np.array(reach)),
            np.array([point.xyz for point in points]).reshape(-1, 3),
            np.array([point.track.length() for point in points], dtype=int),
        )


def adjust(model: Reconstruction) -> Reconstruction:
    """Bundle adjustment of everything but the principal points, in place; returns the model."""
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    with quiet():  # `pycolmap.bundle_adjustment` would turn the log on again
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return model


def best_lens(model: Reconstruction) -> Reconstruction:
    """The reconstruction with the simplest lens model that fits the observations, bundle-adjusted."""
    best, error = model, np.inf
    for kind in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV"):  # from few to many parameters
        copy = pycolmap.Reconstruction(model)
        for camera in copy.cameras.values():
            focal = camera.focal_length_x, camera.focal_length_y
            radial = camera.params[3] if camera.model_name == "SIMPLE_RADIAL" else 0.0
            known = {"f": sum(focal) / 2, "fx": focal[0], "fy": focal[1], "k1": radial}
            known |= {"cx": camera.principal_point_x, "cy": camera.principal_point_y}
            camera.model = getattr(pycolmap.CameraModelId, kind)
            camera.params = [known.get(name, 0.0) for name in MODELS[kind][1].split()]
        adjust(copy)
        lower = float(copy.compute_mean_reprojection_error())
        if lower < 0.99 * error:  # more parameters gain 1e-4 from noise
            best, error = copy, lower
    return best
