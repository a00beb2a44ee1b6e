"""Sentences by which a person asks for an object, and their meaning: object, part and purpose.

An intent is a part that the receiver wants to take and what for. Understanding looks for known
words, whatever the sentence around them: names of objects, of their parts, and of purposes, in any
case, singular or plural.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

from r2h_batch.base.errors import UsageError
from r2h_batch.scene.objects import ObjectModel, load_objects
from r2h_batch.scene.vocabulary import PART_WORDS, THINGS, VERB_WORDS, Thing

TAKE = "take"
ANYWHERE = "object"


@dataclass(frozen=True)
class Intent:
    """A part to take (as people call it), the labels of the mesh that belong to it, a purpose, ways
    to say it."""

    part: str
    labels: tuple[int, ...]
    """indices into the object's `part_names`"""
    verb: str
    phrases: tuple[str, ...]


@dataclass(frozen=True)
class Understood:
    """Meaning of a sentence: `intent` is the row of `intents_of(object)` that answers it."""

    object_index: int
    object: str
    part: str
    verb: str
    intent: int


@lru_cache(maxsize=256)
def intents_of(model: ObjectModel) -> tuple[Intent, ...]:
    """An object's intents, its own instruction's first, "anywhere" last: every part that may be
    taken is in one."""
    thing = _thing(model)
    name = model.name.replace("_", " ")
    allowed = _takeable(model)
    intents: list[Intent] = []
    for part, labels in thing.parts.items():
        chosen = tuple(i for i, n in enumerate(model.part_names) if n in labels and i in allowed)
        if not chosen:
            continue
        text = f"{name} {part}"
        phrases: tuple[str, ...] = (
            f"hand over the {text} to human",
            f"pass me the {name} by its {part}",
            f"give me the {name}, {part} first",
            f"could you hand me the {part} of the {name}?",
            f"I will take the {name} at the {part}",
        )
        intents.append(Intent(part, chosen, TAKE, phrases))
        for verb, where in thing.verbs.items():
            if where == part:
                phrase = VERB_WORDS[verb][0]
                intents.append(
                    Intent(part, chosen, verb, (
                        f"give me the {name} to {phrase}",
                        f"I need the {name}, I want to {phrase}",
                        f"hand over the {name} so that I can {phrase}",
                    ))
                )  # fmt: skip
    phrases = (
        f"hand over the {name} to human",
        f"pass me the {name}",
        f"{name} please",
        f"I want the {name}",
    )
    intents.append(Intent(ANYWHERE, tuple(sorted(allowed)), TAKE, phrases))
    return tuple(intents)


def instructions_of(model: ObjectModel) -> tuple[str, ...]:
    """Every listed way to ask for an object, its own instruction first."""
    phrases = [p for intent in intents_of(model) for p in intent.phrases]
    return tuple(dict.fromkeys([model.instruction, *phrases]))


def understand(
    text: str, objects: Sequence[ObjectModel] | None = None, *, object_index: int | None = None
) -> Understood:
    """The object, part and purpose that a sentence names.

    Without a part, the purpose decides; without a purpose, the receiver's region (S1) or any part
    (S0).

    Args:
        text: the sentence.
        objects: what it may name; None: the 16 built-in ones.
        object_index: what it is about where it names no object ("the handle, please").

    Raises:
        UsageError: it names no object, two, another than `object_index`, or a part that the
            receiver does not take.
    """
    of_these = _understanding(tuple(load_objects() if objects is None else objects))
    return of_these(text, object_index)


@lru_cache(maxsize=8)
def _understanding(objects: tuple[ObjectModel, ...]) -> Callable[[str, int | None], Understood]:
    """`_understand` about some objects, each sentence once. Few of them are kept: methods that see make objects of each
    trial."""
    return lru_cache(maxsize=65536)(partial(_understand, objects))


def _understand(
    objects: tuple[ObjectModel, ...], text: str, object_index: int | None
) -> Understood:
    words = re.findall(r"[a-z0-9]+", text.lower().replace("'s", ""))
    which = _object(text, words, objects, object_index)
    model = objects[which]
    thing, intents = _thing(model), intents_of(model)
    words = _without(words, thing.names)
    named = _only_of(text, model, _find(words, _part_names(model, thing)))
    verb = next((v for v in _find(words, VERB_WORDS, inflected=True) if v in thing.verbs), TAKE)
    whole = model.split == "S1" and set(intents[0].labels) == _takeable(model)
    part = named or thing.verbs.get(verb) or (intents[0].part if whole else ANYWHERE)
    if part not in {i.part for i in intents}:
        part = intents[0].part
    best = [k for k, i in enumerate(intents) if i.part == part and i.verb == verb]
    best += [k for k, i in enumerate(intents) if i.part == part]
    return Understood(which, model.name, part, verb, best[0])


def _object(
    text: str, words: list[str], objects: tuple[ObjectModel, ...], expected: int | None
) -> int:
    found = _find(words, {o.name: _thing(o).names for o in objects})
    index = {o.name: i for i, o in enumerate(objects)}
    # "the cup of the headphones" names one object: its part is called like another one
    kept = [
        n
        for n in found
        if not any(_is_part(objects[index[m]], n, objects) for m in found if m != n)
    ]
    if expected is not None:
        called = _thing(objects[expected]).names  # instances of a family share theirs
        if kept and not any(_thing(objects[index[n]]).names == called for n in kept):
            raise UsageError(
                f"{text!r} is about {_listed(kept)}, but this trial's object is {objects[expected].name}"
            )
        return expected
    if len(kept) == 1:
        return index[kept[0]]
    if len(kept) > 1:
        raise UsageError(f"{text!r} names {_listed(kept)}; name one object")
    verbs = _find(words, VERB_WORDS, inflected=True)
    fitting = [o.name for o in objects if any(v in _thing(o).verbs for v in verbs)]
    if len(fitting) == 1:
        return index[fitting[0]]
    if fitting:
        raise UsageError(f"{text!r} names no object; {_listed(fitting)} would do: name one of them")
    names = [n for o in objects for n in _thing(o).names]
    near = [n for w in words if len(w) > 3 for n in difflib.get_close_matches(w, names, 1, 0.75)]
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise UsageError(
        f"{text!r} names no object; {hint}known are {', '.join(o.name.replace('_', ' ') for o in objects)}"
    )


def _only_of(text: str, model: ObjectModel, parts: list[str]) -> str | None:
    """The part that was named first and may be taken; a sentence that names only other parts is
    refused."""
    takeable = [i.part for i in intents_of(model)]
    for part in parts:
        if part in takeable:
            return part
    if parts:
        allowed = _listed([p for p in dict.fromkeys(takeable) if p != ANYWHERE])
        raise UsageError(
            f"{text!r}: the receiver of the {model.name.replace('_', ' ')} takes {allowed}, "
            f"not {parts[0]}; name one of these, or only the object"
        )
    return None


def _part_names(model: ObjectModel, thing: Thing) -> dict[str, tuple[str, ...]]:
    """Words for every part: what may be taken, then the mesh's own part names."""
    names: dict[str, tuple[str, ...]] = {}
    for part in thing.parts:
        more = (*PART_WORDS.get(part, ()), *thing.part_words.get(part, ()))
        names[part] = (part, *(w for w in more if w not in thing.parts))
    taken = {w for words in names.values() for w in words}
    for label in model.part_names:
        spoken = label.replace("_", " ")
        if spoken not in taken and label not in names:
            names[label] = (spoken, *(w for w in PART_WORDS.get(label, ()) if w not in taken))
    return names


def _is_part(model: ObjectModel, other: str, objects: tuple[ObjectModel, ...]) -> bool:
    """Whether some word for the other object is a word for a part of this one."""
    words = {w for names in _part_names(model, _thing(model)).values() for w in names}
    other_model = next(o for o in objects if o.name == other)
    return any(n in words for n in _thing(other_model).names)


def _find(
    words: Sequence[str], names: Mapping[str, Sequence[str]], *, inflected: bool = False
) -> list[str]:
    """Keys whose words occur, in the order of the sentence."""
    return list(dict.fromkeys(key for _, _, key in _spans(words, names, inflected)))


def _spans(
    words: Sequence[str], names: Mapping[str, Sequence[str]], inflected: bool
) -> list[tuple[int, int, str]]:
    """(first word, number of words, key) of every name said; longer names take their words first,
    exact before stemmed."""
    exact = {tuple(n.split()): key for key, phrase in reversed(list(names.items())) for n in phrase}
    stems = {tuple(_stem(w, inflected) for w in n): key for n, key in exact.items()}
    spans: list[tuple[int, int, str]] = []
    free = [True] * len(words)
    for size in range(max((len(n) for n in exact), default=0), 0, -1):
        for i in range(len(words) - size + 1):
            if all(free[i : i + size]):
                phrase = tuple(words[i : i + size])
                key = exact.get(phrase) or stems.get(tuple(_stem(w, inflected) for w in phrase))
                if key is not None:
                    spans.append((i, size, key))
                    free[i : i + size] = [False] * size
    return sorted(spans)


def _without(words: list[str], names: tuple[str, ...]) -> list[str]:
    """The sentence with a full stop where it first names the object: "the hammer to hammer with"
    keeps one hammer."""
    spans = _spans(words, {"object": names}, False)
    return words if not spans else [*words[: spans[0][0]], ".", *words[spans[0][0] + spans[0][1] :]]


def _stem(word: str, inflected: bool) -> str:
    """A word without its plural; `inflected`: without -ing and -ed either."""
    if inflected and len(word) > 4:
        for ending in ("ing", "ed"):
            if word.endswith(ending) and len(word) - len(ending) >= 3:
                word = word[: -len(ending)]
                if word[-1] == word[-2] and word[-1] not in "sl":
                    word = word[:-1]
                return word.rstrip("e")
    if word.endswith("ies") and len(word) > 4:
        word = word[:-3] + "y"
    elif re.search(r"(s|x|z|ch|sh)es$", word):
        word = word[:-2]
    elif word.endswith("s") and not word.endswith("ss") and len(word) > 3:
        word = word[:-1]
    return word.rstrip("e") if inflected else word


@lru_cache(maxsize=256)
def _thing(model: ObjectModel) -> Thing:
    """Vocabulary of an object; a user's object has the words of its name and of its parts."""
    if model.words is not None:
        return _with_own_parts(model, model.words)
    if model.name in THINGS and any(
        set(p) & set(model.part_names) for p in THINGS[model.name].parts.values()
    ):
        return _with_own_parts(model, THINGS[model.name])
    allowed = _takeable(model)
    parts: dict[str, tuple[str, ...]] = {
        n.replace("_", " "): (n,) for i, n in enumerate(model.part_names) if i in allowed
    }
    if model.split == "S1":
        first = re.search(r"hand over the .*?(\w+) to human", model.instruction)
        if first and first[1] not in parts and first[1] not in model.name:
            parts = {
                first[1]: tuple(n for i, n in enumerate(model.part_names) if i in allowed),
                **parts,
            }
    return Thing(
        names=(model.name.replace("_", " "),), parts=parts, verbs={"use": next(iter(parts))}
    )


def _with_own_parts(model: ObjectModel, thing: Thing) -> Thing:
    """The vocabulary with the mesh's own names of parts that it has no word for: of the receiver's region (S1), which
    somebody else may have declared, or of an object none of whose parts it knows."""
    known = {label for labels in thing.parts.values() for label in labels}
    if model.split == "S0" and known & set(model.part_names):
        return thing
    parts = dict(thing.parts)
    for label in (model.part_names[i] for i in sorted(_takeable(model))):
        if label not in known:
            spoken = label.replace("_", " ")
            parts[spoken] = (*parts.get(spoken, ()), label)
    return replace(thing, parts=parts)


def _takeable(model: ObjectModel) -> frozenset[int]:
    """Labels that a receiver may take: those of the receiver's region, or all."""
    taken = model.face_part[model.receiver_face] if model.receiver_face.any() else model.face_part
    return frozenset(int(i) for i in set(taken.tolist()))


def _listed(names: Sequence[str] | Mapping[str, object]) -> str:
    spoken = [n.replace("_", " ") for n in names]
    return spoken[0] if len(spoken) == 1 else f"{', '.join(spoken[:-1])} and {spoken[-1]}"
