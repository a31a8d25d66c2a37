"""What happened, in plain words: an object between two scans, and a whole room."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from more2_jax.config import SceneConfig
from more2_jax.tracking.changes import changes_between, not_seen_in
from more2_jax.tracking.objects import motion_between, observation_in
from more2_jax.tracking.pose_voting import turns_deg
from more2_jax.types import Changes, LivingScene, Observation, Repair, ScanRecord, SceneObject

LOW_SCORE = 0.5  # a match below it is told as unsure; same objects usually score 0.5 to 0.9
UNLIKELY = 0.6  # as is a change that is less probable than this
LEAST_TURN_DEG = 2.0  # of a scan's frame against the first one's that is worth telling
MUCH_NOISE_M = 0.02  # between two scans; depth cameras have 0.01

Status = Literal["moved", "static", "added", "removed", "not_seen", "discovered", "present", "absent"]
STATES: tuple[Status, ...] = ("moved", "added", "removed", "static", "not_seen", "discovered")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of one object between two scans. Distance and angle are None unless both show it."""

    status: Status
    distance_m: float | None = None
    angle_deg: float | None = None
    doubts: tuple[str, ...] = ()  # why it is unsure; empty when it is not


def changes_from(scene: LivingScene, a: int, b: int, config: SceneConfig) -> Changes:
    """The changes between scans `a` and `b`: those of the scene where it has them, else worked out."""
    known = next((c for c in scene.changes if (c.from_scan, c.to_scan) == (a, b)), None)
    return known or changes_between(scene.objects, a, b, config, not_seen=not_seen_in(scene.scans))


def verdict(o: SceneObject, changes: Changes) -> Verdict:
    """What became of an object between the scans of `changes`; in one and the same scan, whether it is there."""
    before, after = observation_in(o, changes.from_scan), observation_in(o, changes.to_scan)
    doubts = tuple(d for seen in (before, after) if seen for d in doubts_of(o, seen))
    if changes.from_scan == changes.to_scan:
        return Verdict(status="present" if after else "absent", doubts=doubts)
    told: list[Status] = [s for s in STATES if o.id in getattr(changes, s)]
    status = told[0] if told else "absent"
    chance = changes.probability.get(o.id, 1.0)
    if told and chance < UNLIKELY:
        doubts += (f"{status.replace('_', ' ')} with a probability of {chance:.0%} only",)
    if before is None and status in ("moved", "static"):  # the scan before did not look for it
        before = max((s for s in o.observations if s.scan < changes.from_scan), key=lambda s: s.scan)
    if before is None or after is None:
        return Verdict(status=status, doubts=doubts)
    distance_m, angle_deg = motion_between(o, before, after)
    return Verdict(status=status, distance_m=distance_m, angle_deg=angle_deg, doubts=doubts)


def doubts_of(o: SceneObject, seen: Observation) -> list[str]:
    """Why an observation may be wrong, in words. The reference observation defines the object: no doubt."""
    if seen.scan == o.reference_scan:
        return []
    doubts = [] if seen.converged else ["its new position did not settle"]
    if seen.score < LOW_SCORE:
        doubts.append(f"it may be another object: match score {seen.score:.2f}, below {LOW_SCORE:.2f}")
    if not seen.accumulated:
        doubts.append("what was seen of it does not fit well: left out of its shape")
    if seen.interchangeable:
        doubts.append("it may have changed places with a piece that looks the same")
    return doubts


def motion_text(o: SceneObject, changes: Changes) -> str:
    """What happened to the object between two scans: `moved 2.00 m, 90.0°`, `static`, … or `absent`."""
    v = verdict(o, changes)
    if v.distance_m is None:
        return v.status.replace("_", " ")
    return f"{v.status} {v.distance_m:.2f} m, {v.angle_deg:.1f}°"


def upright_text(name: str, upright: bool, likely_up: str | None) -> str:
    """How objects are taken to move, where the first scan decides it, and what to say if they move otherwise.

    `likely_up`: axis of the scan, +x to -z; None where nothing points to one.
    """
    if upright:
        return f"{name} shows a level floor: objects stay upright (--any-orientation if they do not)"
    if likely_up in (None, "+z"):
        return f"{name} shows no floor across z: objects may turn in any way (--upright if z is up and they do not)"
    axis = likely_up.removeprefix("+")
    return (
        f"{name}: {likely_up} is likely up, not z: objects may turn in any way (--up {axis} if they do not)"
    )


def leveled_text(scene: LivingScene, scan: ScanRecord) -> str | None:
    """`friday: leveled by 3.2°`; None of a scan that was taken as given, or in a scene that is not upright."""
    tilt_deg = scan.frame.tilt_deg
    return f"{scan.name}: leveled by {tilt_deg:.1f}°" if scene.upright and tilt_deg > 0 else None


def frame_text(scene: LivingScene, scan: ScanRecord) -> str | None:
    """`friday: lies in a frame of its own, turned by 67° against monday`; None of a scan in the scene's.

    Where nothing told how a scan lies, that is said instead.
    """
    first = scene.scans[0]
    if scan.frame.unknown:
        return (
            f"{scan.name}: does not fit {first.name} as given, and nothing tells how it lies: its objects are matched,"
            " but what of them moved, and how far, is in doubt"
        )
    T = np.linalg.inv(first.frame.T_scene_scan) @ scan.frame.T_scene_scan
    yaw = np.abs(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))  # each scan's tilt is told by itself
    turn_deg = float(np.rad2deg(yaw) if scene.upright else turns_deg(T[None, :3, :3], np.eye(3))[0])
    if turn_deg < LEAST_TURN_DEG:
        return None
    return f"{scan.name}: lies in a frame of its own, turned by {turn_deg:.0f}° against {first.name}"


def noise_text(scene: LivingScene, scan: ScanRecord) -> str | None:
    """`friday: surfaces lie some 2.4 cm off those before, by noise and drift: …`; None at the usual noise."""
    if scan.frame.noise_m < MUCH_NOISE_M:
        return None
    off = f"surfaces lie some {100 * scan.frame.noise_m:.1f} cm off those before, by noise and drift"
    return f"{scan.name}: {off}: small motions cannot be told"


def repair_text(scan: ScanRecord, repair: Repair) -> str:
    """`friday: instances 3 and 5 are object_002, in parts (92 % on it)`."""
    if repair.divided is not None:
        both = f"{repair.object} and {repair.divided}"
        if not repair.instances:
            return f"{scan.name}: one mask of the scan before held {both} ({repair.share:.0%} sure)"
        return f"{scan.name}: instance {repair.instances[0]} is {both} in one mask ({repair.share:.0%} sure)"
    if repair.unmasked:
        where = f"as instance {repair.instances[0]}" if repair.instances else "in the scan before"
        points = f"{repair.unmasked} points without a mask are {repair.object}, {where}"
        return f"{scan.name}: {points} ({repair.share:.0%} sure)"
    if repair.dropped or repair.regained:
        return f"{scan.name}: {_border_text(repair)} ({repair.share:.0%} within half the tolerance)"
    sure = f"in parts ({repair.share:.0%} on it)"
    if repair.smooth:
        sure = f"in parts that go on in one another ({repair.smooth:.0%} of their border is smooth)"
    if repair.absorbed:
        return (
            f"{scan.name}: {_listed(repair.absorbed)} of the scan before and {repair.object} are one, {sure}"
        )
    return f"{scan.name}: instances {_listed(map(str, repair.instances))} are {repair.object}, {sure}"


def _border_text(r: Repair) -> str:
    """`40 of 900 points in the mask of object_002 (instance 3) are floor or wall, and left out`."""
    mask = f"instance {r.instances[0]}" if r.instances else "in an earlier scan"
    if r.regained:
        return (
            f"{r.regained} points beside the {r.points} of {r.object} ({mask}) are part of it, and taken in"
        )
    whose = f"{r.neighbor}'s" if r.neighbor else "floor or wall"
    return f"{r.dropped} of {r.points} points of {r.object} ({mask}) are {whose}, and left out"


def _listed(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def phrase(v: Verdict) -> str:
    """A verdict as a person would say it."""
    if v.status == "moved":
        return _moved(v.distance_m or 0.0, v.angle_deg or 0.0)
    words = {
        "static": "stayed where it was",
        "added": "added",
        "removed": "removed",
        "not_seen": "not seen: the scan did not look where it stood, or shows it without a mask",
        "discovered": "discovered: no scan had looked here, or one shows it without a mask",
        "present": "here",
        "absent": "not here",
    }
    return words[v.status]


def _moved(distance_m: float, angle_deg: float) -> str:
    """`moved by 1.20 m and turned by 35°`; below a centimeter or a degree only the other is said."""
    far, turned = distance_m >= 0.01, angle_deg >= 0.5
    length = f"{100 * distance_m:.0f} cm" if distance_m < 1 else f"{distance_m:.2f} m"
    if far and turned:
        return f"moved by {length} and turned by {angle_deg:.0f}°"
    return f"turned by {angle_deg:.0f}°" if turned else f"moved by {length}"


def headline(scene: LivingScene, verdicts: Sequence[Verdict], a: int, b: int) -> str:
    """One sentence on a room: `Between monday and friday: 3 objects moved, 1 was added, 2 stayed.`"""
    counts = Counter(v.status for v in verdicts)
    if a == b:
        return f"{scene.scans[b].name}: {_objects(counts['present'])} found."
    first = True
    parts = []
    for status, one, more in (
        ("moved", "moved", "moved"),
        ("added", "was added", "were added"),
        ("removed", "was removed", "were removed"),
        ("static", "stayed", "stayed"),
        ("not_seen", "was not seen", "were not seen"),
        ("discovered", "was discovered", "were discovered"),
    ):
        if n := counts[status]:
            parts.append(f"{_objects(n) if first else n} {one if n == 1 else more}")
            first = False
    doubtful = sum(bool(v.doubts) for v in verdicts if v.status != "absent")
    unsure = f" {doubtful} of these {'is' if doubtful == 1 else 'are'} unsure." if doubtful else ""
    told = ", ".join(parts) or "no object is in either"
    return f"Between {scene.scans[a].name} and {scene.scans[b].name}: {told}.{unsure}"


def _objects(n: int) -> str:
    return f"{n} object{'' if n == 1 else 's'}"
