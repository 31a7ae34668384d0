"""Settings: types, ranges, units, files."""

import dataclasses
import re
import typing
from pathlib import Path

import mvcore.config as config_module
import numpy as np
import pytest
from mvcore import Config, FormatError, InvalidInputError
from mvcore.config import Checked, DepthConfig, VolumeConfig

SECTIONS = {f.name: f.default_factory for f in dataclasses.fields(Config) if f.default_factory is not dataclasses.MISSING}
FIELDS = [(section, f.name) for section, cls in SECTIONS.items() for f in dataclasses.fields(cls)]


def hints(section):
    return typing.get_type_hints(SECTIONS[section], include_extras=True)


@pytest.mark.parametrize(("section", "name"), FIELDS)
def test_every_setting_is_checked(section, name):
    cls, kind = SECTIONS[section], hints(section)[name]
    wrong = ["text", [1], {}]
    if kind is not bool:
        number = next(k for k in (kind, *typing.get_args(kind)) if typing.get_origin(k) is typing.Annotated)
        base, meta = typing.get_args(number)
        assert meta.extra["unit"]
        for end in (meta.ge, meta.le):  # both ends are allowed; a setting that others bound says so by another name
            try:
                cls(**{name: base(end)})
            except InvalidInputError as error:
                assert re.search(rf"{section}\.\w+: expected at (least|most) {section}\.", str(error))  # noqa: PT017
        wrong += [base(meta.ge) - 1, base(meta.le) * 2, float("nan"), float("inf"), float("-inf"), True, "3", 1e300, -1e300]
    for value in wrong:
        with pytest.raises(InvalidInputError, match=rf"^{section}\.{name}: expected .+, got "):
            cls(**{name: value})
        with pytest.raises(InvalidInputError, match=rf"^{section}\.{name}: expected .+, got "):
            Config.from_dict({section: {name: value}})


def test_messages_name_range_unit_and_what_came():
    with pytest.raises(InvalidInputError) as error:
        DepthConfig(coarsest=0)
    assert str(error.value) == "depth.coarsest: expected a whole number from 16 to 65536 (pixels), got 0"
    with pytest.raises(InvalidInputError, match=r"depth\.p2: expected at least depth\.p1 \(90\), got 60"):
        DepthConfig(p1=90)
    with pytest.raises(InvalidInputError, match=r"device: expected one of cpu, cuda, got 'tpu'"):
        Config(device="tpu")
    with pytest.raises(InvalidInputError, match=r"depth: expected a DepthConfig"):
        Config(depth=VolumeConfig())
    with pytest.raises(InvalidInputError, match=r"config: unknown key 'depht'; did you mean 'depth'"):
        Config.from_dict({"depht": {}})


def test_numpy_numbers_become_plain_ones():
    config = VolumeConfig(voxel=np.float32(0.5), max_memory=np.int64(7), truncation=np.array(4))
    assert config == VolumeConfig(voxel=0.5, max_memory=7, truncation=4.0)
    assert [type(v) for v in (config.voxel, config.max_memory, config.truncation)] == [float, int, float]
    with pytest.raises(InvalidInputError, match=r"volume\.voxel"):
        VolumeConfig(voxel=np.float64("nan"))


def test_settings_from_files(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text('matcher = "dcnn"\n[depth]\nplanes = 64\n[surface]\nmax_faces = 1000\n')
    config = Config.from_file(path)
    assert (config.matcher, config.depth.planes, config.surface.max_faces) == ("dcnn", 64, 1000)
    config = config.updated({"depth": {"coarsest": 100}})
    assert (config.depth.planes, config.depth.coarsest) == (64, 100)
    (tmp_path / "s.json").write_text('{"surface": {"unseen_reach": null}}')
    assert Config.from_file(tmp_path / "s.json").surface.unseen_reach is None
    for text, message in (
        ("[depth]\ncoarsest = 0\n", r"settings\.toml: depth\.coarsest: expected"),
        ("[depth]\nplane = 3\n", r"settings\.toml: .*did you mean 'planes'"),
        ("depth = \n", r"settings\.toml: not a TOML file: .*line 1"),
        ("[depth]\nsmooth = nan\n", r"unknown key 'smooth'"),
    ):
        path.write_text(text)
        with pytest.raises(FormatError, match=message):
            Config.from_file(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(FormatError, match=r"not a TOML file"):
        Config.from_file(path)
    (tmp_path / "s.json").write_text("[" * 100_000)
    with pytest.raises(FormatError, match=r"not a JSON file"):
        Config.from_file(tmp_path / "s.json")
    with pytest.raises(FileNotFoundError, match=r"no such file of settings"):
        Config.from_file(tmp_path / "none.toml")


def test_each_setting_says_why():
    source = Path(config_module.__file__).read_text()
    for section, name in FIELDS:
        body = source[source.index(f"class {SECTIONS[section].__name__}(") :]
        assert re.search(rf'\n    {name}: [^\n]+\n    """', body), f"{section}.{name}"
    assert issubclass(Config, Checked)


def test_files_of_settings_as_windows_editors_write_them(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbf[depth]\r\nsources = 3\r\n")
    (tmp_path / "A.JSON").write_bytes(b'\xef\xbb\xbf{"depth": {"sources": 3}}\r\n')
    for name in ("a.toml", "A.JSON"):
        assert Config.from_file(tmp_path / name).depth.sources == 3
    for name, text in (("deep.toml", "a = " + "[" * 50_000), ("deep.json", "[" * 50_000), ("latin.toml", "a = '\xe4'")):
        (tmp_path / name).write_bytes(text.encode("latin-1"))
        with pytest.raises(FormatError, match=rf"{name}: not a (TOML|JSON) file"):
            Config.from_file(tmp_path / name)
