"""Model folders: what is saved comes back, and nothing that was tampered with gets through or gets to run."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from known_clouds import model
from pcdenoise.errors import ModelError
from pcdenoise.networks import store
from pcdenoise.networks.mcconv import MCConvConfig, MCConvNetwork
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

ONE_LINE = r"^[^\n]+; [^\n]+$"


@pytest.fixture(params=["seeded", "mcconv"])
def kind(request: pytest.FixtureRequest) -> str:
    """Which of the networks the folder holds."""
    return str(request.param)


@pytest.fixture
def folder(tmp_path: Path, kind: str) -> Path:
    """A sound model folder to break."""
    path = tmp_path / "sound"
    store.save(
        model(kind).network, path, summary="for tests", training={"seed": 1}, scores={"cd": 2.5}, card="# A card\n\nσ = 1 %\n"
    )
    return path


def refused(folder: Path, fault: str = "") -> str:
    """The one line with which a folder is refused."""
    with pytest.raises(ModelError, match=ONE_LINE) as caught:
        store.load(folder)
    assert re.search(fault, str(caught.value)), caught.value
    return str(caught.value)


def change_config(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / store.CONFIG
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load

    return load((folder / store.WEIGHTS).read_bytes())


def write_tensors(folder: Path, content: dict[str, torch.Tensor]) -> None:
    from safetensors.torch import save

    (folder / store.WEIGHTS).write_bytes(save(content))


# What is saved comes back


def test_a_saved_model_comes_back_weight_by_weight_and_byte_by_byte(folder: Path, tmp_path: Path, kind: str) -> None:
    loaded = store.load(folder)
    expected = model(kind).network.state_dict()
    assert loaded.network.state_dict().keys() == expected.keys()
    for name, tensor in loaded.network.state_dict().items():
        assert torch.equal(tensor, expected[name]), name
    assert loaded.name == "sound"
    assert loaded.sha256 == hashlib.sha256((folder / store.WEIGHTS).read_bytes()).hexdigest()
    assert (loaded.config.summary, loaded.config.training, loaded.config.scores) == ("for tests", {"seed": 1}, {"cd": 2.5})
    assert not loaded.network.training

    again = tmp_path / "again"
    about = {"summary": "for tests", "training": {"seed": 1}, "scores": {"cd": 2.5}, "card": "# A card\n\nσ = 1 %\n"}
    store.save(loaded.network, again, **about)
    for name in (store.WEIGHTS, store.CONFIG, store.CARD):
        assert (again / name).read_bytes() == (folder / name).read_bytes()
    assert sorted(path.name for path in again.iterdir()) == sorted((store.WEIGHTS, store.CONFIG, store.CARD))


@pytest.mark.parametrize(
    "config",
    [
        ProjectionConfig(4, 6, (1,), 1),
        ProjectionConfig(16, 32, (1, 2, 3), 2),
        ProjectionConfig(8, 12, (2,), 1, messages=12),
        MCConvConfig(8, None, 0.0, unit=5.0),
        MCConvConfig(64, 16, 0.2),
    ],
)
def test_networks_of_other_sizes_come_back_in_their_size(tmp_path: Path, config: ProjectionConfig | MCConvConfig) -> None:
    network = MCConvNetwork(config) if isinstance(config, MCConvConfig) else ProjectionNetwork(config)
    store.save(network, tmp_path, summary="", training={}, scores={}, card="")
    assert store.load(tmp_path).network.config == config
    assert store.info(tmp_path).n_parameters == sum(p.numel() for p in network.parameters())


def test_saving_over_a_model_replaces_it_whole(folder: Path) -> None:
    network = ProjectionNetwork(ProjectionConfig(8, 12, (1,), 1))
    store.save(network, folder, summary="other", training={}, scores={}, card="other")
    assert store.load(folder).network.config == network.config
    assert (folder / store.CARD).read_text() == "other"


def test_the_shipped_models_are_sound_small_and_have_a_card() -> None:
    listed = list(store.available())
    assert store.DEFAULT in [entry.name for entry in listed]
    for entry in listed:
        loaded = store.load(entry.name)
        assert loaded.config == entry.config
        assert store.load(entry.path).sha256 == loaded.sha256
        assert entry.n_parameters < 100_000
        assert (entry.path / store.CARD).read_text()


def test_a_folder_wins_over_a_shipped_model_of_that_name(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.rename(tmp_path / store.DEFAULT)
    shipped = store.load().sha256
    monkeypatch.chdir(tmp_path)
    assert store.load(store.DEFAULT).sha256 != shipped


# Nothing tampered with gets through


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../default", "default/../default", "no such", "/", "a/b", "default\x00", "~root"]
)
def test_names_that_are_no_model_are_refused_with_what_there_is(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A name leads into the folder of shipped models or to a folder that the user means, never out of the former.
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=ONE_LINE) as caught:
        store.load(name)
    assert store.DEFAULT in str(caught.value)


@pytest.mark.parametrize("missing", [store.WEIGHTS, store.CONFIG])
def test_a_missing_file_is_named(folder: Path, missing: str) -> None:
    (folder / missing).unlink()
    refused(folder, "no such model" if missing == store.CONFIG else store.WEIGHTS)


@pytest.mark.parametrize("name", [store.WEIGHTS, store.CONFIG])
def test_a_directory_in_place_of_a_file_is_refused(folder: Path, name: str) -> None:
    (folder / name).unlink()
    (folder / name).mkdir()
    refused(folder)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999), name=st.sampled_from([store.WEIGHTS, store.CONFIG]))
def test_a_truncated_file_is_refused(folder: Path, share: float, name: str) -> None:
    path = folder / name
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * (len(whole) - 1))])
    refused(folder, name)
    path.write_bytes(whole)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1), bit=st.integers(0, 7), name=st.sampled_from([store.WEIGHTS, store.CONFIG]))
def test_a_flipped_bit_is_refused_in_one_line_or_gives_another_sound_model(
    folder: Path, place: float, bit: int, name: str
) -> None:
    path = folder / name
    whole = path.read_bytes()
    header = struct.unpack("<Q", whole[:8])[0] if name == store.WEIGHTS else len(whole)  # the part that has a structure
    row = int(place * (min(8 + header, len(whole)) - 1))
    path.write_bytes(whole[:row] + bytes([whole[row] ^ 1 << bit]) + whole[row + 1 :])
    try:
        loaded = store.load(folder)
    except ModelError as fault:
        assert re.match(ONE_LINE, str(fault))
    else:
        assert all(bool(tensor.isfinite().all()) for tensor in loaded.network.state_dict().values())
    finally:
        path.write_bytes(whole)


def test_files_larger_than_any_model_are_not_even_read(folder: Path) -> None:
    for name in (store.WEIGHTS, store.CONFIG):
        whole = (folder / name).read_bytes()
        with (folder / name).open("ab") as file:
            file.truncate(1 << 40)  # sparse: takes no room on disk, but would in memory
        refused(folder, "larger than any model")
        (folder / name).write_bytes(whole)


def test_a_config_that_would_fill_memory_once_it_is_parsed_is_not_parsed(folder: Path) -> None:
    (folder / store.CONFIG).write_bytes(b"[" + b"[]," * (8 << 20) + b"0]")  # 24 MB of text, 500 MB of lists
    refused(folder, "larger than any model")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs devices and pipes")
@pytest.mark.parametrize("name", [store.WEIGHTS, store.CONFIG])
def test_links_to_devices_pipes_and_themselves_are_refused_at_once(folder: Path, name: str) -> None:
    path = folder / name
    path.unlink()
    for place in (Path("/dev/zero"), path, folder / "pipe"):
        if place.name == "pipe":
            os.mkfifo(place)
        path.symlink_to(place)
        refused(folder)
        path.unlink()


def test_a_header_that_promises_more_than_there_is_is_refused(folder: Path) -> None:
    for length in (2**63, 2**40, 10**7):
        (folder / store.WEIGHTS).write_bytes(struct.pack("<Q", length) + b"{}")
        refused(folder, "not a safetensors file")
    huge = json.dumps({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    (folder / store.WEIGHTS).write_bytes(struct.pack("<Q", len(huge)) + huge)
    refused(folder, "not a safetensors file")


def test_pickles_are_not_read_let_alone_run(folder: Path, tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    (folder / store.WEIGHTS).write_bytes(pickle.dumps(Trap()))
    refused(folder, "not a safetensors file")
    torch.save(model("seeded").network.state_dict(), folder / store.WEIGHTS)
    refused(folder, "not a safetensors file")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_numbers_are_refused(folder: Path, value: float) -> None:
    content = tensors(folder)
    next(tensor for tensor in content.values() if tensor.is_floating_point()).view(-1)[0] = value
    write_tensors(folder, content)
    refused(folder, "not all numbers")


@pytest.mark.parametrize(
    "kind_of_number", [torch.float64, torch.float16, torch.bfloat16, torch.int32, torch.bool, torch.float8_e4m3fn]
)
def test_weights_of_another_type_are_refused_not_converted(folder: Path, kind_of_number: torch.dtype) -> None:
    """1e300 is a number in float64 and none in the network's float32."""
    sound = tensors(folder)
    name = next(name for name, tensor in sound.items() if tensor.dtype == torch.float32)
    other = torch.full_like(sound[name], 1e300 if kind_of_number == torch.float64 else 1, dtype=kind_of_number)
    write_tensors(folder, {**sound, name: other})
    refused(folder, "is [A-Z].*, not F32")


def test_weights_of_another_shape_or_name_are_refused(folder: Path) -> None:
    sound = tensors(folder)
    name = next(name for name, tensor in sorted(sound.items()) if tensor.dim())  # they come in any order
    for content in (
        {},
        {key: tensor for key, tensor in sound.items() if key != name},
        {**sound, "extra": torch.zeros(1)},
        {**sound, name: sound[name][:-1].clone()},
        {**sound, name: torch.zeros(2, 2, 2)},
    ):
        write_tensors(folder, content)
        refused(folder, store.WEIGHTS)
    write_tensors(folder, sound)
    assert store.load(folder)


CONFIG_CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "unknown key": lambda c: c.update(code="import os"),
    "unknown setting": lambda c: c["settings"].update(device="cuda"),
    "another network": lambda c: c.update(network="projection" if c["network"] == "mcconv" else "mcconv"),
    "an unknown network": lambda c: c.update(network="transformer"),
    "no network": lambda c: c.pop("network"),
    "no settings": lambda c: c.pop("settings"),
    "settings of another kind": lambda c: c.update(settings=[1, 2]),
    "too many channels": lambda c: c["settings"].update(channels=10**9),
    "negative channels": lambda c: c["settings"].update(channels=-1),
    "too many neighbours": lambda c: c["settings"].update(neighbours=10**9),
    "too many rounds": lambda c: c["settings"].update(rounds=[10**9]),
    "no round": lambda c: c["settings"].update(rounds=[0]),
    "negative rounds": lambda c: c["settings"].update(rounds=[-1]),
    "no stage": lambda c: c["settings"].update(rounds=[]),
    "too many stages": lambda c: c["settings"].update(rounds=[1] * 1000),
    "channels of text": lambda c: c["settings"].update(channels="many"),
    "other channels": lambda c: c["settings"].update({"width" if c["network"] == "mcconv" else "channels": 16}),
    "too wide": lambda c: c["settings"].update(width=10**6),
    "too many sampled": lambda c: c["settings"].update(sampled=10**9),
    "nothing kept": lambda c: c["settings"].update(dropout=1.0),
    "no unit": lambda c: c["settings"].update(unit=0.0),
    "a unit without end": lambda c: c["settings"].update(unit=float("inf")),
}


@pytest.mark.parametrize("name", CONFIG_CHANGES)
def test_a_config_that_is_not_ours_is_refused(folder: Path, name: str) -> None:
    change_config(folder, CONFIG_CHANGES[name])
    refused(folder)


@pytest.mark.parametrize(
    "content",
    [b"", b"null", b"[]", b"{", b"\xff\xfe\x00", b"[" * 100_000, b'{"network": NaN}', b"1" * 5000],
    ids=["empty", "null", "list", "open", "no text", "deep", "NaN", "long number"],
)
def test_a_config_that_is_no_object_is_refused(folder: Path, content: bytes) -> None:
    (folder / store.CONFIG).write_bytes(content)
    refused(folder, store.CONFIG)
    with pytest.raises(ModelError, match=ONE_LINE):
        store.info(folder)
