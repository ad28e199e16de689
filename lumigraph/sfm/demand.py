"""Memory and time of a capture, estimated from the number and the size of its photographs, and numbers that fit.

Measured with COLMAP 4 on one core of about 3 GHz (docs/capture.md): features with 1 and 2 threads at 1600 and 3200
pixels, pairs at 1,200 to 12,400 features, mapping of 15 to 60 photographs.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..budget import lasting
from ..errors import LumigraphError
from ..system.memory import MAX_THREADS, free_memory, gigabytes
from .pairs import LOOK_VIEWS, LOOP_CANDIDATES, RETRIEVED_VIEWS, SEQUENTIAL_NEIGHBOURS, Matching, exhaustive, sequential
from .photos import Photo

PROCESS_BYTES = 400_000_000  # of this process and COLMAP's before the first photograph
DECODED_BYTES = 8  # per pixel of the file, in each thread
FEATURE_BYTES = 290  # per pixel of the reduced photograph, in each thread: the scale space of SIFT
OBSERVATION_BYTES = 700  # per feature of all photographs, while cameras are adjusted
FREE_SHARE = 0.8  # share of the free memory that a capture plans with
READING_SECONDS = 0.015  # per megapixel of the file
FEATURE_SECONDS = 1.4  # per megapixel of the reduced photograph
PAIR_SECONDS, PRODUCT_SECONDS = 0.01, 2e-9  # per pair, and per product of its two numbers of features
MAPPING_SECONDS, MAPPING_POWER = 1.0e-5, 1.3  # per feature of a photograph, and of the number of photographs
MIN_SIDE, MIN_FEATURES = 400, 512  # pixels and features that a capture is reduced to at the least


@dataclass(frozen=True)
class Demand:
    """Parameters of a capture that determine its memory and time.

    size:     (width, height) of the largest photograph
    max_size: longer side in pixels for feature detection
    preempt:  leave pairs that share little out, see `choose_pairs`
    """

    count: int
    size: tuple[int, int]
    matching: Matching
    max_size: int
    features: int
    threads: int
    preempt: bool = False

    @property
    def reduced(self) -> float:
        """Pixels of a photograph for feature detection."""
        return reduced_pixels(self.size, self.max_size)

    @property
    def detection(self) -> float:
        """Bytes of feature detection in one thread."""
        return DECODED_BYTES * math.prod(self.size) + FEATURE_BYTES * self.reduced

    @property
    def mapping(self) -> float:
        """Bytes of mapping."""
        return OBSERVATION_BYTES * self.count * self.features

    @property
    def memory(self) -> float:
        """Peak memory in bytes."""
        return PROCESS_BYTES + max(self.threads * self.detection, self.mapping)

    @property
    def pairs(self) -> int:
        """Largest number of pairs to match."""
        if self.matching == "exhaustive" or self.count <= SEQUENTIAL_NEIGHBOURS:
            pairs = len(exhaustive(self.count))
            return min(pairs, (LOOK_VIEWS + 2) * self.count) if self.preempt else pairs
        if self.matching == "sequential":
            return len(sequential(self.count)) + LOOP_CANDIDATES * self.count
        return (RETRIEVED_VIEWS + SEQUENTIAL_NEIGHBOURS) * self.count * 2 // 3  # some are each other's

    @property
    def seconds(self) -> float:
        """Duration in seconds on idle cores."""
        cores = min(os.cpu_count() or 1, MAX_THREADS)
        reading = READING_SECONDS * self.count * math.prod(self.size) / 1e6
        comparing = self.pairs * (PAIR_SECONDS + PRODUCT_SECONDS * self.features**2)
        detecting = FEATURE_SECONDS * self.count * self.reduced / 1e6 / min(cores, self.threads)
        mapping = MAPPING_SECONDS * self.features * self.count**MAPPING_POWER
        return detecting + (reading + comparing) / cores + mapping

    def say(self) -> str:
        """Sentence with memory and time, shown before the start."""
        width, height = self.size
        side = min(self.max_size, max(self.size))
        every = "those that share most" if self.preempt else "all"
        kinds = {"exhaustive": every, "sequential": "neighbours", "retrieval": "those that look alike"}
        time = lasting(max(10 * math.ceil(self.seconds / 10), 10))
        return (
            f"{self.count:,} photographs of up to {width}x{height} pixels: {self.features:,} features each at {side:,} "
            f"pixels, and about {self.pairs:,} pairs ({kinds.get(self.matching, self.matching)}); about {time} on "
            f"{os.cpu_count() or 1} idle cores, and at most {gigabytes(self.memory)} of memory, of "
            f"{gigabytes(free_memory())} that are free"
        )


def reduced_pixels(size: tuple[int, int], max_size: int) -> float:
    """Pixels of a photograph whose longer side is reduced to `max_size`, if it is longer."""
    return math.prod(size) * min(1.0, max_size / max(size)) ** 2


def fitted(asked: Demand, free: float) -> tuple[Demand, list[str]]:
    """The demand reduced to fit into free bytes, and sentences on the reductions: threads first, then the size of
    photographs, then features. Raises LumigraphError where even the minimum does not fit."""
    room, found, cuts = FREE_SHARE * free - PROCESS_BYTES, asked, []
    threads = int(room // found.detection)
    found = replace(found, threads=max(1, min(asked.threads, threads)))
    if threads < 1:
        side = math.sqrt(max(room - DECODED_BYTES * math.prod(asked.size), 0) / FEATURE_BYTES / asked.reduced)
        found = replace(found, max_size=int(side * min(asked.max_size, max(asked.size))))
    if found.mapping > room:
        found = replace(found, features=max(int(room / OBSERVATION_BYTES / asked.count), 0))
    needed = gigabytes((replace(asked, threads=1).memory) / FREE_SHARE)
    if found.max_size < min(MIN_SIDE, asked.max_size) or found.features < min(MIN_FEATURES, asked.features):
        raise LumigraphError(
            f"{asked.count:,} photographs of {asked.size[0]}x{asked.size[1]} pixels would need {needed} of memory, and "
            f"{gigabytes(free)} are free; give smaller or fewer photographs, or end other programs"
        )
    if found.threads < asked.threads:
        more = gigabytes(replace(asked, features=0).memory / FREE_SHARE)
        threads_used = "1 thread" if found.threads == 1 else f"{found.threads} threads"
        cuts.append(
            f"Memory allows {threads_used} at a time for features instead of {asked.threads}, which takes longer; with "
            f"{more} free it would be all"
        )
    if found.max_size < asked.max_size:
        cuts.append(
            f"Memory allows features at {found.max_size:,} pixels instead of {asked.max_size:,}; with {needed} free, "
            f"delete the scene's folder and give --max-size {asked.max_size}"
        )
    if found.features < asked.features:
        cuts.append(
            f"Memory allows {found.features:,} features of each photograph instead of {asked.features:,}; with "
            f"{needed} free, the same command takes all"
        )
    return found, cuts


def demand_of(
    photos: Sequence[Photo], matching: Matching, max_size: int, features: int, preempt: bool = False
) -> Demand:
    """Demand of photographs, with as many threads as the processor has."""
    size = max((photo.size for photo in photos), key=math.prod)
    return Demand(len(photos), size, matching, max_size, features, min(os.cpu_count() or 1, MAX_THREADS), preempt)
