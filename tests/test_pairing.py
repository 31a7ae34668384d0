"""Files pair with views by name, in natural order, or are refused."""

from pathlib import Path

import pytest
from mvcore import FormatError
from mvcore.io.pairing import natural_order, pair_by_name


def paired(names, files, **more):
    return [None if p is None else p.as_posix() for p in pair_by_name(names, [Path(f) for f in files], "mask", **more)]


def test_ten_comes_after_nine():
    names = [Path(f"f{n}.png") for n in (10, 9, 100, 1)]
    assert [p.stem for p in sorted(names, key=natural_order)] == ["f1", "f9", "f10", "f100"]


@pytest.mark.parametrize(
    ("names", "files", "expected"),
    [
        (["images/b.jpg", "images/a.jpg"], ["m/a.jpg", "m/b.jpg"], ["m/b.jpg", "m/a.jpg"]),
        (["b.jpg", "a.jpg"], ["a.jpg.png", "b.jpg.png"], ["b.jpg.png", "a.jpg.png"]),
        (["left", "top"], ["TOP.mp4", "left.mp4"], ["left.mp4", "TOP.mp4"]),
        (["v02.jpg", "v10.jpg", "v1.jpg"], ["mask_1.png", "mask_10.png", "mask_2.png"], ["mask_2.png", "mask_10.png", "mask_1.png"]),
        (["c0/1.jpg", "c1/1.jpg"], ["m/c1/1.png", "m/c0/1.png"], ["m/c0/1.png", "m/c1/1.png"]),
        (["cam0", "cam1", "cam2"], ["0003.jpg", "0001.jpg", "0002.jpg"], ["0001.jpg", "0002.jpg", "0003.jpg"]),
        (["a", "b"], ["x10.png", "x9.png"], ["x9.png", "x10.png"]),
        (["a", "b"], ["b.png", "c.png", "a.png"], ["a.png", "b.png"]),
        (["a.jpg", "b.jpg"], ["m/a.png", "m/old/a.png", "m/b.png", "m/old/b.png"], ["m/a.png", "m/b.png"]),
        (["left.jpg", "top.jpg"], ["top_mask.png", "a_mask.png", "left_mask.png"], ["left_mask.png", "top_mask.png"]),
        (["left.jpg", "top.jpg"], ["mask-top.png", "Mask-Left.png"], ["Mask-Left.png", "mask-top.png"]),
        (["mask.jpg", "b.jpg"], ["b.png", "mask.png"], ["mask.png", "b.png"]),
    ],
)
def test_pairs(names, files, expected):
    assert paired(names, files) == expected


def test_names_that_fit_partly_are_refused_or_left_out():
    with pytest.raises(FormatError, match=r"no mask for top \(1 of 3 have none\); rear.mp4 belongs to none"):
        paired(["left", "right", "top"], ["left.mp4", "rear.mp4", "right.mp4"])
    assert paired(["a.jpg", "b.jpg", "c.jpg"], ["c.png", "a.png"], partial=True) == ["a.png", None, "c.png"]
    assert paired(["c0/1.jpg", "c1/1.jpg"], ["m/c1/1.jpg"], partial=True) == [None, "m/c1/1.jpg"]
    with pytest.raises(FormatError, match="3 of 3 have none"):
        paired(["a", "b", "c"], ["x.png", "y.png"], partial=True)
    with pytest.raises(FormatError, match="2 of 2 have none"):
        paired(["a", "b"], ["x.png", "y.png"], exact=True)


def test_words_for_masks_count_of_masks_alone():
    with pytest.raises(FormatError, match="2 of 2 have none"):
        pair_by_name(["left.jpg", "top.jpg"], [Path("left_mask.png"), Path("top_mask.png"), Path("x.png")], "image", exact=True)


def test_two_files_for_one_name_are_refused():
    with pytest.raises(FormatError, match=r"left: expected one mask, got left.avi and left.mp4"):
        paired(["left", "right"], ["left.mp4", "left.avi", "right.mp4"])
    with pytest.raises(FormatError, match=r"a.jpg: expected one mask, got m/new/a.png and m/old/a.png"):
        paired(["a.jpg", "b.jpg"], ["m/new/a.png", "m/old/a.png", "m/b.png"])
    with pytest.raises(FormatError, match="belongs to both"):
        paired(["v1.jpg", "v01.jpg"], ["1.png", "2.png", "3.png"])
