"""Understanding of sentences: listed phrases, free ones, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from rounds import each

from r2h_batch.base.errors import UsageError
from r2h_batch.scene.objects import BUILT_IN_NAMES, INSTANCE_NAMES, load_objects
from r2h_batch.scene.vocabulary import THINGS
from r2h_batch.trials.holding.instructions import ANYWHERE, instructions_of, intents_of, understand

OBJECTS = load_objects()

FREE = [
    ("Please pass me the wine glass!", "wineglass", "object", "take"),
    ("I'd like those scissors, I am cutting paper", "scissors", "loops", "cut"),
    ("I need a hammer to pound nails", "hammer", "handle", "hammer"),
    ("bring the cordless drill, pistol grip towards me, I'm boring holes", "power_drill", "grip", "drill"),
    ("I will hold the binoculars by the right tube", "binoculars", "right barrel", "take"),
    ("the bowl of the wineglass", "wineglass", "bowl", "take"),
]


@pytest.mark.parametrize(("text", "name", "part", "verb"), FREE)
def test_phrases_that_are_in_no_list_are_understood(text: str, name: str, part: str, verb: str) -> None:
    assert all(text not in instructions_of(o) for o in OBJECTS)
    found = understand(text)
    assert (found.object, found.part, found.verb) == (name, part, verb)
    assert OBJECTS[found.object_index].name == name


@pytest.mark.check
def test_every_listed_phrase_is_understood_as_its_own_intent_in_any_case() -> None:
    for index, model in enumerate(OBJECTS):
        assert len(instructions_of(model)) >= 8
        for intent in intents_of(model):
            for phrase in intent.phrases:
                for said in (phrase, phrase.upper()):
                    found = understand(said)
                    assert found.object_index == index
                    answer = intents_of(model)[found.intent]
                    assert set(answer.labels) == set(intent.labels) and found.verb == intent.verb, said


def test_an_objects_own_instruction_asks_for_the_receivers_region() -> None:
    for index, model in enumerate(OBJECTS):
        found = understand(model.instruction)
        assert found.object_index == index
        if model.split == "S1":
            region = set(model.face_part[model.receiver_face].tolist())
            assert set(intents_of(model)[found.intent].labels) == region


@pytest.mark.parametrize(
    ("text", "index", "message"),
    [
        ("pass me the hamer", None, "did you mean 'hammer'.*known are game controller, bowl"),
        ("the knife and the cup", None, "names knife and cup; name one object"),
        ("hand me the hammer by its head", None, "takes handle, not head; name one of these, or only the object"),
        ("the hammer handle", 0, "is about hammer, but this trial's object is game_controller"),
    ],
)
def test_what_cannot_be_answered_is_refused_with_what_is_allowed(text: str, index: int | None, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        understand(text, object_index=index)


@pytest.mark.parametrize(
    ("name", "parts", "asked", "taken", "refused"),
    [
        ("trigger_sprayer", ["bottle"], "hand over the trigger sprayer bottle to human", {"bottle"}, "trigger"),
        ("bottle", ["body", "base"], "hand over the bottle body to human", {"body", "base"}, "cap"),
        ("binoculars", ["barrel", "right_barrel"], "hand me the binoculars by the barrel", {"barrel"}, "bridge"),
    ],
)
def test_a_region_that_somebody_else_declared_is_asked_for_by_the_names_of_its_parts(
    name: str, parts: list[str], asked: str, taken: set[str], refused: str
) -> None:
    (own,) = load_objects([name])
    labels = [own.part_names.index(p) for p in parts]
    model = replace(own, receiver_face=np.isin(own.face_part, labels), instruction=asked)
    found = understand(asked, [model])
    answer = intents_of(model)[found.intent]
    assert {model.part_names[k] for k in answer.labels} == taken
    for intent in intents_of(model):
        for phrase in intent.phrases:
            assert set(intents_of(model)[understand(phrase, [model]).intent].labels) == set(intent.labels), phrase
    with pytest.raises(UsageError, match=r"the receiver of the .* takes "):
        understand(f"hand me the {name.replace('_', ' ')} by its {refused}", [model])


def test_shipped_objects_have_words_for_every_part_of_their_region() -> None:
    for model in each(o for o in load_objects(INSTANCE_NAMES + BUILT_IN_NAMES) if o.split == "S1"):
        spoken = {i.part for i in intents_of(model)} - {ANYWHERE}
        category = model.name if model.name in THINGS else model.name.rpartition("_")[0]
        assert spoken == set(THINGS[category].parts), model.name
