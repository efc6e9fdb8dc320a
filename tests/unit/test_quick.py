"""Which tests `./dev test --quick` takes."""

import pytest
import quick

IMPORTS = {"a": {"b"}, "b": {"c"}, "c": set(), "d": set()}
TESTS = {"tests/test_a.py": {"a"}, "tests/test_c.py": {"c", "tests/rig.py"}, "tests/test_d.py": {"d"}}


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["c"], (3, 1, quick.FAR)),
        (["a"], (1, quick.FAR, quick.FAR)),
        (["tests/rig.py"], (quick.FAR, 1, quick.FAR)),
        (["tests/test_d.py", "b"], (2, quick.FAR, 0)),
        ([], (quick.FAR, quick.FAR, quick.FAR)),
    ],
)
def test_a_test_is_as_far_as_its_imports_lead(changed, expected):
    found = quick.distances(changed, IMPORTS, TESTS)
    assert tuple(found[path] for path in TESTS) == expected


def test_the_nearest_are_taken_first_within_the_time():
    far = {"near_long": 1, "near": 1, "far": 2, "changed": 0}
    seconds = {"near_long": 50.0, "near": 10.0, "far": 5.0, "changed": 100.0}
    taken = [choice.path for choice in quick.choose(far, seconds, 120.0)]
    assert taken == ["changed", "near", "far"]
    assert [choice.path for choice in quick.choose(far, seconds, 1.0)] == ["changed"]


def test_files_are_named_as_their_modules():
    assert quick.module_of("drivers/tmcl/driver.py") == "sioms.drivers.tmcl.driver"
    assert quick.module_of("drivers/tmcl/rig.toml") == "sioms.drivers.tmcl"
    assert quick.module_of("sioms/client/__init__.py") == "sioms.client"
    assert quick.module_of("docs/axis.md") == ""
