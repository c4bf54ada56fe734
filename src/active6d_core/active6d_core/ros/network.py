"""Who can reach the nodes: this machine only unless asked, and a ROS domain that belongs to one graph alone."""

import fcntl
import os
import socket
import tempfile
from collections.abc import MutableMapping
from pathlib import Path
from typing import IO

#: Fast DDS takes its default transports from the file that this names.
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
#: Without shared memory, whose ports do not always survive a killed process.
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
#: Binds all sockets to 127.0.0.1; the discovery range alone leaves them on every interface, and adds shared memory.
LOOPBACK_PROFILE = Path(__file__).with_name("loopback.xml")
# DDS derives ports from the domain; those of domains above 101 collide with the ones Linux hands out.
_LAST_DOMAIN = 101
_FIRST_PORT, _PORTS_PER_DOMAIN = 7410, 250


class DomainError(ValueError):
    """A ROS domain that cannot be used; the text says why and what to do."""


def keep_on_this_machine(environment: MutableMapping[str, str] = os.environ) -> None:
    """Restrict what is started with this environment to 127.0.0.1, as far as nothing else is set."""
    fast_dds = "fastrtps" in environment.get("RMW_IMPLEMENTATION", "fastrtps")
    if fast_dds and environment.setdefault(PROFILES, str(LOOPBACK_PROFILE)) == str(LOOPBACK_PROFILE):
        environment[RANGE] = "SYSTEM_DEFAULT"  # as the profile says; every other range adds to it
    else:
        environment.setdefault(RANGE, "LOCALHOST")


def open_to_network(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let other machines reach what is started with this environment, by UDP alone if nothing else is set."""
    environment.setdefault(TRANSPORTS, "UDPv4")


def describe_reach(environment: MutableMapping[str, str] = os.environ) -> str:
    """Where nodes with this environment can be reached, in words."""
    if environment.get("ROS_SECURITY_ENABLE", "").lower() == "true":
        return "with SROS 2 security, by nodes with keys"
    if environment.get(PROFILES) == str(LOOPBACK_PROFILE):
        return "on this machine only"
    if environment.get(PROFILES):
        return f"as {environment[PROFILES]} says"
    if environment.get(RANGE) == "LOCALHOST":
        return f"from hosts that know the address; {RANGE}=LOCALHOST limits discovery only"
    return "from the network"


def domain_of(environment: MutableMapping[str, str] = os.environ) -> int | None:
    """The domain that ``ROS_DOMAIN_ID`` names, None without one.

    Raises:
        DomainError: it is no domain.
    """
    text = environment.get("ROS_DOMAIN_ID", "")
    if not text:
        return None
    if not text.isdecimal() or not text.isascii() or int(text) > 232:
        raise DomainError(f"ROS_DOMAIN_ID is '{text}', expected a number from 0 to {_LAST_DOMAIN}")
    return int(text)


def explain_start(error: RuntimeError) -> str:
    """Why a ROS context could not be initialised, and what to do."""
    if "logging" in str(error):
        return f"the log folder cannot be written; set ROS_LOG_DIR to another one ({error})"
    return str(error)


class DomainClaim:
    """A domain that this process has for its graph alone, until :meth:`release` or its end.

    Other commands of this project on this machine respect it. Other programs are noticed by the ports that they use.

    Args:
        domain: the domain to claim, None for the first free one.
        namespace: of the graph; graphs in several namespaces may share a domain that was named.

    Raises:
        DomainError: another command has the domain, or none is free.
    """

    def __init__(self, domain: int | None = None, namespace: str = "") -> None:
        wanted = [domain] if domain is not None else _candidates()
        for each in wanted:
            self._file = _lock(each, namespace)
            if self._file is not None and (domain is not None or not is_used(each)):
                self.domain = each
                return
            self.release()
        if domain is None:
            raise DomainError(f"none of the ROS domains 1 to {_LAST_DOMAIN} is free; end other graphs first")
        where = f" in namespace {namespace}" if namespace else ""
        raise DomainError(
            f"another active6d command runs a graph in ROS domain {domain}{where}; wait for its end, or set another "
            "ROS_DOMAIN_ID, or none"
        )

    def release(self) -> None:
        """Give the domain back."""
        if self._file is not None:
            self._file.close()
            self._file = None


def is_used(domain: int) -> bool:
    """Whether a participant on this machine is in a domain: the first one has the first port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", _FIRST_PORT + _PORTS_PER_DOMAIN * domain))
        except OSError:
            return True
    return False


def _candidates() -> list[int]:
    first = os.getpid() % _LAST_DOMAIN
    return [1 + (first + step) % _LAST_DOMAIN for step in range(_LAST_DOMAIN)]


def _lock(domain: int, namespace: str) -> IO[bytes] | None:
    name = f"active6d_{os.getuid()}_domain_{domain}{namespace.strip('/').replace('/', '_')}.lock"
    try:
        file = (Path(tempfile.gettempdir()) / name).open("ab")
    except OSError as error:
        raise DomainError(f"no lock file in {tempfile.gettempdir()}: {error.strerror}; set TMPDIR") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file
