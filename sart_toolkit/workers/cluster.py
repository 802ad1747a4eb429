"""Workers on the nodes of a Ray cluster, which share no disk and may be lost."""

from __future__ import annotations

import collections
import concurrent.futures
import logging
import os
import pickle
import shutil
import signal
import socket
import tempfile
import threading
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from sart_toolkit.data.records import library_versions
from sart_toolkit.errors import InvalidInput, Mismatch, SartError
from sart_toolkit.userfiles import copy_of
from sart_toolkit.workers.parcels import Home, Parcel, arrive, pack, unpack
from sart_toolkit.workers.processes import THREAD_COUNTS

_log = logging.getLogger(__name__)
# So often may an item, or a start, cost its worker.
_MOST_LOSSES = 3
# How long [s] is waited for a first worker, for the nodes to start processes and import.
_START_SECONDS = 300.0
_CLOSE_SECONDS = 10.0
_CONNECT_SECONDS = 10.0


# --- the cluster --------------------------------------------------------------------------------


@contextmanager
def ray_map(
    make_worker: Callable[[], Any], count: int, address: str | None, gpu: bool
) -> Iterator[Callable[[Iterable[Any]], Iterator[Any]]]:
    """A function that maps items to results in order, on a Ray cluster; see `worker_map`.

    Raises:
        InvalidInput: there are more workers than the cluster has CPUs.
        Mismatch: a node has another version of the toolkit or of what results depend on.
        SartError: there is no such cluster, or an item's worker was lost again and again.
    """
    # Before Ray is imported, which reads them: it reports to nobody, and prints nothing on stdout,
    # where it would say at length that a node is lost.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")
    import ray

    with _connected(ray, count, address):
        team = _Team(ray, make_worker, count, gpu)
        try:
            yield team.map
            team.close()
        finally:
            team.kill()


@contextmanager
def _connected(ray: Any, count: int, address: str | None) -> Iterator[None]:
    """Within it this process belongs to the cluster; a cluster of its own ends with it."""
    if ray.is_initialized():
        yield
        return
    address = address or os.environ.get("RAY_ADDRESS")
    with _handlers_kept():
        _join(ray, count, address)
    try:
        yield
    finally:
        ray.shutdown()


def _join(ray: Any, count: int, address: str | None) -> None:
    """Make this process part of the cluster at the address, or of a new one.

    Raises:
        InvalidInput: it is no address.
        SartError: there is no such cluster, or none can be started.
    """
    options = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address != "local":
        try:
            if address not in (None, "auto"):
                _check_answers(address)
            ray.init(address or "auto", **options)
            return
        except (ConnectionError, RuntimeError, ray.exceptions.RayError) as error:
            if address is not None:
                raise SartError(
                    f"ray_address {address!r}: can't join that cluster ({_line(error)}); start one "
                    "with `ray start --head`, and this command on one of its nodes"
                ) from error
    cpus = max(count, os.cpu_count() or 1)
    try:
        ray.init("local", num_cpus=cpus, include_dashboard=False, **options)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise SartError(
            f"no Ray cluster can be started here ({_line(error)}); if it is the path of its "
            "temporary folder, set RAY_TMPDIR to another"
        ) from error


def _check_answers(address: str) -> None:
    """Return if something listens there; Ray itself would ask for minutes.

    Raises:
        InvalidInput: it is no address of that kind.
        ConnectionError: nothing does.
    """
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        raise InvalidInput(f"ray_address: expected HOST:PORT, auto or local, got {address!r}")
    try:
        socket.create_connection((host, int(port)), _CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ConnectionError(str(error)) from error


@contextmanager
def _handlers_kept() -> Iterator[None]:
    """Ray takes SIGTERM for itself; within this what handles it stays."""
    main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if main else ()
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_Answer: TypeAlias = "concurrent.futures.Future[Any]"


class _Member(NamedTuple):
    """A worker on the cluster, and the node that it is on."""

    actor: Any
    node: str


class _Team:
    """The workers of one map: those that start, those that wait for work, and no lost ones."""

    def __init__(self, ray: Any, make_worker: Callable[[], Any], count: int, gpu: bool) -> None:
        self._ray = ray
        resources = ray.cluster_resources()
        if count > resources.get("CPU", 0):
            raise InvalidInput(
                f"workers: expected at most {resources.get('CPU', 0):.0f}, the CPUs of the "
                f"cluster, got {count}; use fewer, or add nodes with `ray start`"
            )
        options: dict[str, Any] = {
            "num_cpus": 1,
            "runtime_env": {"env_vars": {n: os.environ.get(n, "1") for n in THREAD_COUNTS}},
        }
        if gpu and (gpus := resources.get("GPU", 0)):
            # Ray counts in ten-thousandths.
            options["num_gpus"] = min(1.0, int(1e4 * gpus / count) / 1e4)
        actor = _actor_class()
        self._actor = ray.remote(**options)(actor)
        work = pack(make_worker, ray.put)
        self._outputs = work.outputs
        # In a list Ray hands them on unread: a node without the toolkit could not read them.
        self._parcels = [ray.put(pack(Home(), ray.put)), ray.put(work)]
        self._versions = versions_here(actor)
        self._starting: dict[_Answer, Any] = {}
        self._idle: list[_Member] = []
        self._busy: dict[_Answer, tuple[_Member, int]] = {}
        self._failed_starts = 0
        for _ in range(count):
            self._start()

    def _start(self) -> None:
        actor = self._actor.remote()
        self._starting[actor.start.remote(self._versions, self._parcels).future()] = actor

    def map(self, items: Iterable[Any]) -> Iterator[Any]:
        """The results of items in order; whoever is free takes the next one."""
        wanted = list(items)
        waiting = collections.deque(range(len(wanted)))
        losses: collections.Counter[int] = collections.Counter()
        done: dict[int, _Outcome] = {}
        for i in range(len(wanted)):
            while i not in done:
                while waiting and self._idle:
                    member, n = self._idle.pop(), waiting.popleft()
                    self._busy[member.actor.work.remote(pack(wanted[n])).future()] = member, n
                answer = self._next_answer()
                if answer in self._starting:
                    self._started(answer)
                    continue
                member, n = self._busy.pop(answer)
                try:
                    done[n] = answer.result()
                    self._idle.append(member)
                except self._ray.exceptions.RayError as error:
                    losses[n] += 1
                    if losses[n] == _MOST_LOSSES:
                        raise SartError(
                            f"a worker was lost {_MOST_LOSSES} times at {_short(wanted[n])}, last "
                            f"on node {member.node}: {_line(error)}; what it needs may be more "
                            "than a node has"
                        ) from error
                    self._lost(member, error)
                    waiting.appendleft(n)
            yield done.pop(i).value(self._outputs)

    def _next_answer(self) -> _Answer:
        """The first answer that a worker has given."""
        asked = [*self._busy, *self._starting]
        timeout = None if self._busy else _START_SECONDS
        # Ray's own ways to wait make a KeyboardInterrupt of whatever a signal's handler raises.
        answered = concurrent.futures.wait(asked, timeout, concurrent.futures.FIRST_COMPLETED).done
        if not answered:
            free = self._ray.available_resources().get("CPU", 0)
            raise SartError(
                f"no worker has started within {_START_SECONDS:.0f} s, of the cluster's CPUs "
                f"{free:.0f} are free; see `ray status`"
            )
        return answered.pop()

    def _started(self, answer: _Answer) -> None:
        actor = self._starting.pop(answer)
        try:
            node, differing, outcome = answer.result()
        except self._ray.exceptions.RayError as error:
            self._failed_starts += 1
            if self._failed_starts == _MOST_LOSSES:
                raise SartError(
                    f"{_MOST_LOSSES} workers were lost while they started, last: {_line(error)}; "
                    "see `ray status` and the logs of the node"
                ) from error
            self._start()
            return
        if differing:
            raise Mismatch(f"node {node} has {differing}; install the same versions there as here")
        outcome.value()
        self._failed_starts = 0
        self._idle.append(_Member(actor, node))

    def _lost(self, member: _Member, error: Exception) -> None:
        """Replace a worker that is lost, and those that wait on its node, which may be lost too."""
        _log.warning(
            "a worker on node %s was lost (%s); its part is done again", member.node, _line(error)
        )
        doubtful = [other for other in self._idle if other.node == member.node]
        self._idle = [other for other in self._idle if other.node != member.node]
        for each in (member, *doubtful):
            self._ray.kill(each.actor)
            self._start()

    def close(self) -> None:
        """Let the workers free what they hold."""
        closing = [member.actor.close.remote() for member in self._idle]
        self._ray.wait(closing, num_returns=len(closing), timeout=_CLOSE_SECONDS)

    def kill(self) -> None:
        """End all workers, whatever they are at."""
        busy = [member for member, _ in self._busy.values()]
        actors = [member.actor for member in [*self._idle, *busy]]
        for actor in [*actors, *self._starting.values()]:
            self._ray.kill(actor)


def _line(error: BaseException) -> str:
    """The first line of what an error says."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _short(item: Any) -> str:
    text = repr(item)
    return text if len(text) <= 80 else f"{text[:77]}..."


# --- what a node must have ----------------------------------------------------------------------

# Besides the versions of packages: what is in the toolkit, of which a checkout has no version.
_CONTENT = ("sart_toolkit's code", "sart_toolkit's assets")


def versions_here(actor: type[Any]) -> dict[str, str]:
    """What this machine has of all that results depend on, as actors of the class would find it."""
    found: dict[str, str] = actor.versions([*library_versions(), *_CONTENT])
    return found


def _actor_class() -> type[Any]:
    """The class of actors. Made here, so that Ray sends it whole: a node may lack the toolkit."""

    class Actor:
        @staticmethod
        def versions(names: Iterable[str]) -> dict[str, str]:
            """The version of each package here, or the hash of its content."""
            import hashlib
            import importlib.metadata
            import importlib.util
            import pathlib
            import platform

            found = {}
            for name in names:
                package, _, part = name.partition("'s ")
                spec = importlib.util.find_spec(package) if part else None
                if part and (spec is None or spec.origin is None):
                    found[name] = "none"
                elif part and spec is not None and spec.origin is not None:
                    folder, pattern = pathlib.Path(spec.origin).parent, "*.py"
                    if part == "assets":
                        inside, pattern = folder / "assets", "*"
                        folder = inside if inside.is_dir() else folder.parent / "assets"
                    sha = hashlib.sha256()
                    for path in sorted(folder.rglob(pattern)):
                        if path.is_file():
                            content = hashlib.sha256(path.read_bytes()).hexdigest()
                            sha.update(f"{path.relative_to(folder)} {content}\n".encode())
                    found[name] = sha.hexdigest()[:12]
                elif name == "python":
                    found[name] = platform.python_version()
                else:
                    try:
                        found[name] = importlib.metadata.version(name)
                    except importlib.metadata.PackageNotFoundError:
                        found[name] = "none"
            return found

        def start(self, here: dict[str, str], parcels: list[Any]) -> Any:
            """The node's name, what it has in other versions, and what came of the start."""
            import ray

            number = ray.get_runtime_context().get_node_id()[:8]
            node = f"{ray.util.get_node_ip_address()} ({number})"
            there = self.versions(here)
            differing = [
                f"{k} {there[k]} instead of {here[k]}" for k in here if there[k] != here[k]
            ]
            if differing:
                return node, ", ".join(differing), None
            from sart_toolkit.workers.cluster import NodeWorker

            self.worker = NodeWorker()
            return node, "", self.worker.start(*ray.get(parcels))

        def work(self, item: Any) -> Any:
            """What came of an item."""
            return self.worker.work(item)

        def close(self) -> None:
            """Free what is held."""
            self.worker.close()

    return Actor


# --- on the node --------------------------------------------------------------------------------


class _Outcome(NamedTuple):
    """What came of a call: the parcel of a result, or the pickled error."""

    parcel: Parcel | None
    error: bytes = b""

    def value(self, outputs: Collection[Path] = ()) -> Any:
        """The result, its files written; or the error, raised."""
        if self.parcel is None:
            raise pickle.loads(self.error)  # noqa: S301 - from a worker of our own
        return unpack(self.parcel, outputs=outputs)


class NodeWorker:
    """A worker on a node, with the folder that its files are in."""

    def start(self, home: Parcel, work: Parcel) -> _Outcome:
        """Make the worker; no result."""
        import ray

        def make() -> None:
            self._folder = _folder()
            self._outputs = work.outputs
            arrive(home, self._folder, ray.get)
            self._worker = unpack(work, ray.get)()

        return _outcome(make)

    def work(self, item: Parcel) -> _Outcome:
        """The result of an item."""
        outcome = _outcome(lambda: self._worker(unpack(item)), self._outputs)
        for name in outcome.parcel.files if outcome.parcel is not None else ():
            copy_of(name).unlink()
        return outcome

    def close(self) -> None:
        """Free what is held."""
        self._worker.close()
        shutil.rmtree(self._folder, ignore_errors=True)


def _outcome(call: Callable[[], Any], outputs: Collection[Path] = ()) -> _Outcome:
    try:
        return _Outcome(pack(call(), outputs=outputs))
    except Exception as error:
        error.add_note(f"On the node:\n{traceback.format_exc()}")
        try:
            return _Outcome(None, pickle.dumps(error))
        except Exception:
            return _Outcome(None, pickle.dumps(SartError(f"{type(error).__name__}: {error}")))


def _folder() -> Path:
    """A new folder for this process's files; those of processes that were killed are removed."""
    base = Path(tempfile.gettempdir()) / f"sart_toolkit-{os.getuid()}"
    base.mkdir(mode=0o700, exist_ok=True)
    for left in base.iterdir():
        try:
            os.kill(int(left.name.partition("-")[0]), 0)
        except ProcessLookupError:
            shutil.rmtree(left, ignore_errors=True)
        except (ValueError, PermissionError):
            continue
    return Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=base))
