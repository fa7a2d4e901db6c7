"""Who does the parts of a calibration that do not depend on each other: this process, or the machines of a Ray cluster.

A part gives the same bits wherever it is done, as long as the processors are of one kind: it is divided among threads
in the same way, and whatever is random in it was drawn before, or has a seed of its own.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

from .artifact.load import Artifact, load_artifact
from .errors import CalibrationError, ClusterError, TtscompileError, first_line, needing

LOCAL = "local"
"""In the place of an address: a cluster of this machine's cores, for as long as the command runs."""

RETRIES = 3
"""How often a part is begun again whose process has died."""

_OPENED: dict[str, Callable[[Any], Any]] = {}
"""In a process of Ray: what was opened for the work under way. It takes seconds, and parts milliseconds."""


@dataclass(frozen=True)
class Work:
    """What is done with each part.

    Attributes:
        elsewhere: makes the same function in another process; importable there.
        given: what it is made from. Sent once, and not with each part.
        threads: whether ``here`` may run in several threads at once.
    """

    here: Callable[[Any], Any]
    elsewhere: Callable[..., Callable[[Any], Any]]
    given: tuple[Any, ...]
    threads: bool = False


class Pool(Protocol):
    """See ``Here`` and ``RayPool``; ``count`` parts are worth giving at once."""

    count: int

    def map(self, work: Work, parts: Sequence[Any]) -> Iterator[Any]:
        """What comes of each part, in the order of the parts."""


class Here:
    """This process."""

    count = 1

    def map(self, work: Work, parts: Sequence[Any]) -> Iterator[Any]:
        """See ``Pool``."""
        if not work.threads:
            yield from map(work.here, parts)
            return
        with workers() as threads:
            found = list(threads.map(work.here, parts))
        yield from found


class RayPool:
    """The cores of a Ray cluster, as long as this is open.

    Args:
        address: of the cluster, as ``ray.init`` takes it; ``local`` for one of this machine's cores.
        cores: of a local cluster; None for all.

    Raises:
        RuntimeUnavailableError: Ray is not installed.
        ClusterError: nothing answers at the address.
    """

    def __init__(self, address: str, cores: int | None = None) -> None:
        with needing("--ray", "ray"):
            import ray
        self._ray = ray
        own: dict[str, Any] = {"num_cpus": cores, "include_dashboard": False} if address == LOCAL else {}
        try:
            ray.init(address=address, log_to_driver=False, **own)
        except Exception as error:  # a node that does not start in time raises a bare one
            told = f"no cluster can be reached ({first_line(error)}). Start it, or give {LOCAL!r}."
            raise ClusterError(f"--ray {address}: {told}") from error
        self.count = max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._sent: tuple[Work, str, Any] | None = None
        self._run = ray.remote(num_cpus=1, max_retries=RETRIES)(_run)

    def map(self, work: Work, parts: Sequence[Any]) -> Iterator[Any]:
        """See ``Pool``. A part whose process dies is begun again, ``RETRIES`` times.

        Raises:
            ClusterError: the cluster is gone, or a part ends every process that does it.
            TtscompileError: what a part raised.
        """
        import torch

        try:
            if self._sent is None or self._sent[0] is not work:
                self._sent = work, uuid4().hex, self._ray.put(work.given)
            _, key, given = self._sent
            threads = torch.get_num_threads()  # sums are divided among them
            running = [self._run.remote(key, work.elsewhere, threads, given, part) for part in parts]
            for each in running:
                yield self._ray.get(each)
        except TtscompileError:
            raise
        except (self._ray.exceptions.RayError, ConnectionError) as error:
            first = str(error).strip().splitlines()[-1][:200]
            raise ClusterError(
                f"the Ray cluster is gone, or a part of the work ends its process: {first}. What was done is kept: the"
                " same command with --resume goes on, with --ray or without."
            ) from error

    def __enter__(self) -> "RayPool":
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()


@contextmanager
def workers() -> Iterator[ThreadPoolExecutor]:
    """As many threads as torch would use for one operation, for whole calls and without gradients; torch uses one each.

    The operations of a policy are small: divided among threads they spend much of their time waiting for the slowest
    part, most of all on a machine that does something else as well. Whole calls wait for nobody; and since they are
    divided in the same way however many workers there are, so are the results.
    """
    import torch

    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(count, "ttscompile-calibration", torch.set_grad_enabled, (False,)) as pool:
            yield pool
    finally:
        torch.set_num_threads(count)


@contextmanager
def opened_pool(address: str | None) -> Iterator[Pool]:
    """The cluster at an address, or this process where there is none."""
    if address is None:
        yield Here()
        return
    with RayPool(address) as pool:
        yield pool


def artifact_elsewhere(path: str, identity: str) -> Artifact:
    """The artifact in another process. Raises CalibrationError: on its machine there is another one, or none."""
    try:
        artifact = load_artifact(Path(path))
    except TtscompileError as error:
        remedy = "All machines of the cluster need the artifact under the same path: use a shared folder."
        raise CalibrationError(f"a machine of the cluster cannot open the artifact: {error} {remedy}") from error
    if artifact.manifest.identity != identity:
        raise CalibrationError(f"{path}: a machine of the cluster has another artifact there. Copy it again.")
    return artifact


def artifact_arguments(artifact: Artifact) -> tuple[str, str]:
    """The arguments of ``artifact_elsewhere``."""
    return str(artifact.path.resolve()), artifact.manifest.identity


def _run(
    key: str, elsewhere: Callable[..., Callable[[Any], Any]], threads: int, given: tuple[Any, ...], part: Any
) -> Any:
    import torch

    torch.set_num_threads(threads)
    if key not in _OPENED:
        _OPENED.clear()
        _OPENED[key] = elsewhere(*given)
    return _OPENED[key](part)
