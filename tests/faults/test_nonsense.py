"""What a profile is edited to is never one, and a refusal of it says what is wrong, where, and what to do."""

import numpy as np
import pytest

from stagectl.errors import ProfileError
from stagectl.profile import PROFILES_FOLDER, load_profile
from tests.faults.nonsense import DRAWS, nonsense

DRAWN_COUNT = 400


def said_of(path) -> str:
    try:
        load_profile(path)
    except ProfileError as error:
        return f"kept as it was: {error}"
    return "read again"


@pytest.mark.parametrize("profile", ["single-axis", "oled-printer"])
def test_nonsense_is_refused_clearly_whatever_it_is(profile, tmp_path):
    for seed in range(DRAWN_COUNT):
        folder = tmp_path / str(seed)
        folder.mkdir()
        path = folder / f"{profile}.toml"
        path.write_bytes((PROFILES_FOLDER / path.name).read_bytes())
        assert load_profile(path).name == profile
        drawn = nonsense(np.random.default_rng(seed), profile)
        drawn.put(path)
        assert drawn.missed([said_of(path)]) == [], f"seed {seed}"


def test_a_seed_is_the_same_nonsense_again_and_all_of_it_is_drawn():
    drawn = [nonsense(np.random.default_rng(seed), "oled-printer") for seed in range(DRAWN_COUNT)]
    assert drawn == [nonsense(np.random.default_rng(seed), "oled-printer") for seed in range(DRAWN_COUNT)]
    whats = {one.what for one in drawn}
    assert len(whats) > DRAWN_COUNT / 2
    assert whats >= {"empty", "no file", "a folder", "noise"}
    text = (PROFILES_FOLDER / "oled-printer.toml").read_text()
    for draw in DRAWS:
        assert len({draw(np.random.default_rng(seed), text).what for seed in range(50)}) > 4


@pytest.mark.parametrize(
    "said",
    [
        "read again",
        "kept as it was: /a/mine.toml: is wrong",
        "kept as it was: macro.mass_kg = nan: must be a finite number; write the true value, in kg",  # where?
        "kept as it was: /a/mine.toml: macro = nan: must be a finite number; write the true value",
        "kept as it was: /a/mine.toml: macro.mass_kg: must be a finite number; write the true value",
        "kept as it was: /a/mine.toml: macro.mass_kg = nan: must be a finite number",
        "kept as it was: Traceback (most recent call last):\n  float nan of macro.mass_kg",
    ],
)
def test_what_is_taken_or_refused_unclearly_is_seen(said):
    clear = "kept as it was: /a/mine.toml: macro.mass_kg = nan: must be a finite number; write the true value, in kg"
    text = (PROFILES_FOLDER / "oled-printer.toml").read_text()
    drawn = (DRAWS[0](np.random.default_rng(seed), text) for seed in range(100_000))
    one = next(one for one in drawn if one.what == "macro.mass_kg = nan")
    assert one.missed([clear]) == []
    assert one.missed([said]) != []
    assert one.missed([clear, said]) != []
    assert one.missed([]) != []
