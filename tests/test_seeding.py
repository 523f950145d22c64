import pytest
import torch

from rumi import seeding
from rumi.errors import UsageError
from rumi.seeding import check_seed, generator


def test_same_seed_same_bytes():
    first = seeding.normal((4, 3), generator=seeding.generator(7), dtype=torch.float64)
    again = seeding.normal((4, 3), generator=seeding.generator(7), dtype=torch.float64)
    other = seeding.normal((4, 3), generator=seeding.generator(8), dtype=torch.float64)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_streams_depend_on_seed_and_name_alone():
    source = seeding.generator(3)
    early = seeding.split(source, "planner")
    torch.rand(100, generator=source)
    late = seeding.split(source, "planner")
    draw = torch.rand(8, generator=early)
    assert torch.equal(draw, torch.rand(8, generator=late))
    assert torch.equal(draw, torch.rand(8, generator=seeding.split(3, "planner")))
    assert not torch.equal(draw, torch.rand(8, generator=seeding.split(3, "filter")))
    assert not torch.equal(draw, torch.rand(8, generator=seeding.split(4, "planner")))


def test_streams_of_neighbouring_seeds_are_uncorrelated():
    draws = torch.stack([torch.randn(4000, generator=seeding.split(seed, "x")) for seed in range(6)])
    correlation = torch.corrcoef(draws) - torch.eye(6)
    assert correlation.abs().max() < 5 / 4000**0.5


def test_a_split_can_be_split_again():
    deep = seeding.split(seeding.split(0, "a"), "b")
    assert deep.initial_seed() >= 0
    assert deep.initial_seed() != seeding.split(0, "b").initial_seed()


@pytest.mark.parametrize("draw", [seeding.normal, seeding.uniform])
def test_row_of_a_batch_is_the_row_alone(draw):
    batch = draw((3, 5, 2), generator=[seeding.generator(seed) for seed in (10, 11, 12)])
    for row, seed in enumerate((10, 11, 12)):
        assert torch.equal(batch[row], draw((5, 2), generator=seeding.generator(seed)))


def test_moments():
    generator = seeding.generator(0)
    normal = seeding.normal((20000,), generator=generator)
    uniform = seeding.uniform((20000,), generator=generator)
    assert abs(float(normal.mean())) < 0.03
    assert abs(float(normal.std()) - 1) < 0.03
    assert float(uniform.min()) >= 0 and float(uniform.max()) < 1
    assert abs(float(uniform.mean()) - 0.5) < 0.01


def test_wrong_number_of_generators_says_so():
    with pytest.raises(ValueError, match=r"each of the 3 rows of shape \(3, 2\), got 2"):
        seeding.normal((3, 2), generator=[seeding.generator(0), seeding.generator(1)])


def test_the_global_generator_is_not_touched():
    state = torch.random.get_rng_state()
    seeding.normal((5,), generator=seeding.split(0, "x"))
    assert torch.equal(state, torch.random.get_rng_state())


@pytest.mark.parametrize("seed", [-1, 2**63, 1.0, "1", None])
def test_a_seed_that_is_none_is_refused(no_shape_check, seed):
    with pytest.raises(UsageError, match=r"Expected --seed to be 0 or more, below 2\*\*63, got"):
        check_seed(seed, "--seed")


def test_the_greatest_seed_makes_a_generator():
    check_seed(2**63 - 1)
    assert generator(2**63 - 1).initial_seed() == 2**63 - 1
