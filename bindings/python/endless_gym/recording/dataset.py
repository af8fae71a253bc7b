"""Writes episodes as a Minari data set, in the format HDF5.

Minari's own writer stores frames as JPEG, which is lossy, or without compression. This one compresses them losslessly, in chunks,
while the episodes are played. Minari reads both formats.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import gymnasium

from endless_gym.recording.chunks import LEVEL, Chunks
from endless_gym.recording.episodes import Episode

_INSTALL = "pip install './bindings/python[minari]', or the wheel file with `[minari]` appended"
if sys.version_info < (3, 11):
    raise ImportError(
        f"data sets are written with Minari, which needs Python 3.11 or newer, got {sys.version.split()[0]}"
    )
try:
    import h5py
    import minari
    from minari.dataset.minari_dataset import DATASET_ID_RE
    from minari.dataset.minari_storage import MinariStorage
    from minari.namespace import NAMESPACE_METADATA_FILENAME
    from minari.storage import get_dataset_path
except ImportError as error:
    raise ImportError(f"data sets are written with {error.name}, which is not installed: {_INSTALL}") from error

#: The file with the episodes of a data set.
_FILE = "main_data.hdf5"


def check_id(dataset: str) -> str:
    """The id of a data set, as Minari writes it.

    Raises:
        ValueError: It is not of the form `(namespace/)name-v(version)`; the message says where it differs.
    """
    if not isinstance(dataset, str):
        reason = "it must be a string"
    elif wrong := re.search(r"[^-_\w/]", dataset):
        reason = f"it may have letters, digits, `-`, `_` and `/`, not {wrong[0]!r}"
    elif re.search("//|^/|/$", dataset):
        reason = "between its `/` must be names"
    elif not re.search(r"-v\d+$", dataset):
        reason = f"its version is missing: {dataset}-v0"
    elif not (found := DATASET_ID_RE.fullmatch(dataset)) or found["version"] is None:
        reason = "its name must not be empty, nor its namespace shorter than 2 characters"
    else:
        return dataset
    form = "(namespace/)name-v(version), such as mine/mystery-path-v0"
    raise ValueError(f"dataset must be of the form {form}, got {dataset!r}: {reason}")


class DatasetWriter:
    """Writes a data set. It appears under its id when the `with` block ends without an exception; otherwise nothing remains.

    Args:
        dataset: Id of the data set.
        root: Folder of the data sets; `None` for Minari's: `MINARI_DATASETS_PATH`, or `~/.minari/datasets`.
        observation_space: Space of a recorded observation.
        action_space: Space of an action.
        env_spec: The environment that `recover_environment` makes.
        metadata: Further metadata of the data set.
        overwrite: Replace a data set of that id.

    Raises:
        FileExistsError: There is a data set of that id, or another folder of that name.
        ValueError: The id is malformed.
    """

    def __init__(
        self,
        dataset: str,
        root: str | os.PathLike[str] | None,
        *,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        env_spec: gymnasium.envs.registration.EnvSpec,
        metadata: dict[str, Any],
        overwrite: bool = False,
    ) -> None:
        self.dataset = check_id(dataset)
        # Absolute, since Minari joins relative paths twice.
        self.root = Path(get_dataset_path() if root is None else root).absolute()
        #: The folder of the data set.
        self.path = self.root / dataset
        self._spaces = observation_space, action_space
        self._env_spec, self._metadata, self._overwrite = env_spec, metadata, overwrite
        self.episodes, self.steps = 0, 0
        self._check_place()

    def _check_place(self) -> None:
        if not self.path.exists():
            return
        if not (self.path / "data").is_dir():
            raise FileExistsError(f"{self.path} exists and is not a data set; choose another id or remove it")
        if not self._overwrite:
            raise FileExistsError(
                f"the data set {self.dataset} exists in {self.root}; choose another id, or overwrite it"
            )

    def __enter__(self) -> DatasetWriter:
        self.root.mkdir(parents=True, exist_ok=True)
        # Minari ignores folders whose names start with a dot.
        self._folder = Path(tempfile.mkdtemp(prefix=".recording-", dir=self.root))
        try:
            observation_space, action_space = self._spaces
            self._storage = MinariStorage.new(
                self._folder / "data",
                observation_space,
                action_space,
                self._env_spec,
                data_format="hdf5",
                jpeg_encoding=False,
            )
            # The layout of HDF5 1.10 has less overhead per chunk than that of 1.0.
            self._file = h5py.File(self._folder / "data" / _FILE, "w", libver=("v110", "v110"), track_order=True)
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        return self

    def add(self, episode: Episode) -> None:
        """Write the next episode."""
        group = self._file.create_group(f"episode_{self.episodes}")
        plan = episode.plan
        attributes: dict[str, Any] = {
            "id": self.episodes,
            "seed": plan.seed,
            "total_steps": episode.length,
            "error_rate": plan.error_rate,
            "return": episode.total,
            **{f"options/{name}": value for name, value in plan.options.items()},
            **{f"final_info/{name}": value for name, value in episode.final.items()},
        }
        for name, value in attributes.items():
            group.attrs[name] = value
        for name, chunks in (episode.observations | episode.arrays).items():
            _write(group, name, chunks)
        infos = group.create_group("infos")
        if episode.ground_truth is not None:
            _write(infos, "ground_truth", episode.ground_truth)
        self.episodes += 1
        self.steps += episode.length

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._file.close()
            if kind is None:
                self._finish()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _finish(self) -> None:
        """Writes the metadata, and moves the data set into place."""
        self._storage.update_metadata(
            {
                **self._metadata,
                "dataset_id": self.dataset,
                "minari_version": minari.__version__,
                "total_episodes": self.episodes,
                "total_steps": self.steps,
                "dataset_size": float(self._storage.get_size()),
            }
        )
        self._check_place()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for namespace in self.path.relative_to(self.root).parents:
            described = self.root / namespace / NAMESPACE_METADATA_FILENAME
            if namespace != Path() and not described.exists():
                described.write_text(json.dumps({}))
        if self.path.exists():
            os.rename(self.path, self._folder / "replaced")
        # Only the owner can access a folder made by `mkdtemp`.
        finished = self._folder / "finished"
        finished.mkdir()
        os.rename(self._folder / "data", finished / "data")
        os.rename(finished, self.path)


def _write(group: h5py.Group, name: str, chunks: Chunks) -> None:
    shape = (chunks.rows, *chunks.shape[1:])
    dataset = group.create_dataset(
        name, chunks.shape, chunks.dtype, chunks=shape, compression="gzip", compression_opts=LEVEL
    )
    zeros = (0,) * (len(shape) - 1)
    for number, data in enumerate(chunks.data):
        dataset.id.write_direct_chunk((number * chunks.rows, *zeros), data)
