"""The words for objects, their parts and purposes. Names in one tuple mean the same; the first is
what phrases use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Thing:
    """An object in words: its names; its parts as people call them, with the mesh's labels;
    purposes and their part."""

    names: tuple[str, ...]
    parts: Mapping[str, tuple[str, ...]]
    verbs: Mapping[str, str]
    part_words: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


S0_ROLES: dict[str, dict[str, str]] = {
    "game_controller": {"grip": "grasp"},
    "bowl": {"wall": "wrap", "rim": "wrap", "foot": "wrap"},
    "headphones": {"band": "grasp", "padding": "grasp", "slider": "grasp"},
    "eyeglasses": {"temple": "grasp", "hinge": "grasp"},
    "cup": {"wall": "wrap", "rim": "wrap", "base": "wrap"},
    "wineglass": {"stem": "grasp", "foot": "grasp"},
    "can": {"body": "wrap", "lid": "wrap", "base": "wrap"},
    "dispenser": {"bottle": "grasp", "base": "grasp"},
    "bottle": {"base": "grasp"},
}
"""S0 has no receiver's region: the parts that people take these objects by (AffNet labels bowls and
cups wrap-grasp)."""

SHARP: dict[str, tuple[str, ...]] = {
    "knife": ("blade",),
    "scissors": ("blade",),
    "screwdriver": ("tip",),
    "power_drill": ("bit",),
}
"""The parts of built-in objects that nobody should come to first (Presented)."""

VESSELS: dict[str, tuple[str, str]] = {
    "cup": ("base", "rim"),
    "bowl": ("foot", "rim"),
    "wineglass": ("foot", "rim"),
}
"""Open vessels that are built in, and the parts from whose middle to whose middle is up."""

PART_WORDS: dict[str, tuple[str, ...]] = {
    "handle": ("grip", "hilt", "haft", "hold"),
    "grip": ("handle", "handgrip", "hold"),
    "handles": ("grips", "handle"),
    "loops": ("loop", "ring", "finger hole", "handle", "bow"),
    "body": ("side", "middle"),
    "wall": ("side", "body", "outside"),
    "rim": ("edge", "lip", "brim"),
    "base": ("bottom", "foot", "underside"),
    "stem": ("stalk",),
    "temple": ("arm", "leg", "earpiece", "side piece"),
    "band": ("headband", "headrest"),
    "cup": ("ear cup", "earcup", "ear piece", "speaker"),
    "right barrel": ("right tube", "right side", "right half", "barrel"),
    "blade": ("cutting edge", "tip"),
    "neck": ("throat",),
    "cap": ("lid", "top"),
    "bristles": ("brush head",),
    "shaft": ("rod",),
    "jaw": ("nose", "tip"),
    "bit": ("drill bit",),
}

VERB_WORDS: dict[str, tuple[str, ...]] = {
    "use": ("use it", "use", "work"),
    "hammer": ("hammer a nail", "hammer", "hit", "pound", "strike", "nail", "beat"),
    "squeeze": ("squeeze a wire", "squeeze", "grip a wire", "bend", "pinch", "clamp"),
    "cut": ("cut something", "cut", "slice", "snip", "trim", "carve", "open a box", "open the box"),
    "brush": ("brush my teeth", "brush", "clean my teeth", "scrub"),
    "screw": ("drive a screw", "screw", "turn a screw", "tighten", "loosen", "fasten"),
    "drill": ("drill a hole", "drill", "bore", "make a hole"),
    "look": ("look into the distance", "look", "watch", "see", "observe", "view", "spot"),
    "pour": ("pour", "fill a glass", "serve"),
    "drink": ("drink from it", "drink", "sip", "toast"),
    "spray": ("spray the plants", "spray", "mist", "water the plants", "squirt"),
    "eat": ("eat from it", "eat", "dine", "have soup", "have my soup"),
    "wear": ("wear it", "wear", "put on", "put them on", "put it on"),
    "listen": ("listen to music", "listen", "hear"),
    "read": ("read a book", "read"),
    "play": ("play a game", "play", "game"),
    "clean": ("clean it", "clean", "wash", "wipe", "rinse"),
}

THINGS: dict[str, Thing] = {
    "game_controller": Thing(
        ("game controller", "controller", "gamepad", "joypad", "joystick"),
        {"grip": ("grip",), "body": ("body", "stick", "dpad", "button", "trigger")},
        {"play": "grip", "use": "grip"},
    ),
    "bowl": Thing(
        ("bowl", "soup bowl", "dish", "salad bowl"),
        {"wall": ("wall", "foot"), "rim": ("rim",)},
        {"eat": "wall", "pour": "rim", "clean": "rim", "use": "wall"},
    ),
    "headphones": Thing(
        ("headphones", "headphone", "headset", "earphones"),
        {"cup": ("cup", "cushion", "slider"), "band": ("band", "padding")},
        {"wear": "cup", "listen": "cup", "use": "cup", "clean": "band"},
        {"cup": ("cushion", "ear pad", "earpad")},
    ),
    "eyeglasses": Thing(
        ("eyeglasses", "eyeglass", "glasses", "spectacles", "reading glasses", "pair of glasses"),
        {"temple": ("temple", "hinge"), "frame": ("rim", "lens", "bridge", "nose_pad")},
        {"wear": "temple", "read": "temple", "look": "temple", "use": "temple", "clean": "frame"},
        {"frame": ("rim", "lens", "lenses", "front", "bridge")},
    ),
    "cup": Thing(
        ("cup", "mug", "tumbler", "beaker", "paper cup"),
        {"wall": ("wall", "base"), "rim": ("rim",)},
        {"drink": "wall", "pour": "wall", "use": "wall", "clean": "rim"},
    ),
    "wineglass": Thing(
        ("wineglass", "wine glass", "glass", "goblet", "glass of wine"),
        {"stem": ("stem", "foot"), "bowl": ("bowl", "rim")},
        {"drink": "stem", "use": "stem", "clean": "bowl"},
        {"bowl": ("cup", "body", "rim"), "stem": ("foot", "base")},
    ),
    "can": Thing(
        ("can", "tin", "food can", "tin can"),
        {"body": ("body", "base"), "lid": ("lid", "tab")},
        {"use": "body", "clean": "lid"},
        {"lid": ("top", "ring pull", "tab")},
    ),
    "dispenser": Thing(
        ("dispenser", "soap dispenser", "pump bottle", "pump dispenser"),
        {"bottle": ("bottle", "base", "collar"), "pump": ("pump", "nozzle")},
        {"use": "bottle", "clean": "bottle"},
        {"bottle": ("body", "base"), "pump": ("head", "nozzle", "spout")},
    ),
    "hammer": Thing(
        ("hammer", "claw hammer", "mallet"),
        {"handle": ("grip",)},
        {"hammer": "handle", "use": "handle"},
    ),
    "pliers": Thing(
        ("pliers", "plier", "pincers", "tongs", "needle nose pliers"),
        {"handles": ("handle",)},
        {"squeeze": "handles", "use": "handles"},
    ),
    "knife": Thing(
        ("knife", "utility knife", "box cutter", "cutter", "penknife"),
        {"handle": ("handle",)},
        {"cut": "handle", "use": "handle"},
    ),
    "toothbrush": Thing(
        ("toothbrush", "tooth brush"),
        {"handle": ("handle", "grip")},
        {"brush": "handle", "use": "handle"},
    ),
    "screwdriver": Thing(
        ("screwdriver", "screw driver", "driver"),
        {"handle": ("handle",)},
        {"screw": "handle", "use": "handle"},
    ),
    "scissors": Thing(
        ("scissors", "scissor", "shears", "pair of scissors"),
        {"loops": ("loop",)},
        {"cut": "loops", "use": "loops"},
    ),
    "power_drill": Thing(
        ("power drill", "drill", "electric drill", "drilling machine", "cordless drill"),
        {"grip": ("grip", "trigger")},
        {"drill": "grip", "use": "grip"},
        {"grip": ("trigger", "pistol grip")},
    ),
    "binoculars": Thing(
        ("binoculars", "binocular", "field glasses", "field glass", "spyglass"),
        {"right barrel": ("right_barrel", "right_eyecup")},
        {"look": "right barrel", "use": "right barrel"},
        {"right barrel": ("right eyecup",)},
    ),
    "bottle": Thing(
        ("bottle", "water bottle", "flask"),
        {"body": ("base",)},
        {"drink": "body", "pour": "body", "use": "body"},
        {"body": ("base", "bottom", "lower half", "lower part")},
    ),
    "trigger_sprayer": Thing(
        (
            "trigger sprayer",
            "sprayer",
            "spray bottle",
            "spray",
            "spray gun",
            "plant sprayer",
            "mister",
        ),
        {"grip": ("neck", "collar", "head", "trigger")},
        {"spray": "grip", "clean": "grip", "use": "grip"},
        {"grip": ("neck", "collar", "head", "trigger", "top")},
    ),
}


def split_roles(roles: Mapping[str, str] | None) -> tuple[dict[str, str] | None, tuple[str, ...]]:
    """Part -> function, grasp or wrap, None where no part has such a role; and the parts that are sharp.

    Args:
        roles: part -> one of these words, or sharp.
    """
    sharp = tuple(sorted(part for part, word in (roles or {}).items() if word == "sharp"))
    others = {part: word for part, word in (roles or {}).items() if part not in sharp}
    return (others if others or not sharp else None) if roles is not None else None, sharp
