"""Keyframes left out on the way: the chain stays whole, and its uncertainty that of the whole way."""

import numpy as np

from seamark.frontend import se3
from seamark.frontend.types import Features, Keyframe
from seamark.service.nodes.keyframe_relay import KeyframeRelay

SAMPLES = 20_000


def keyframe(number: int, session: int, previous: int | None, T: np.ndarray, sigma: float) -> Keyframe:
    return Keyframe(
        number,
        session,
        number,
        number,
        "",
        Features.empty(),
        np.zeros((0, 3), np.float32),
        np.zeros((0, 0), np.uint8),
        b"",
        previous_id=previous,
        T_odom_cam=T,
        covariance=np.diag([sigma**2] * 3 + [(2 * sigma) ** 2] * 3),
    )


def poses(rng: np.random.Generator, count: int) -> list[np.ndarray]:
    T, out = np.eye(4), []
    for _ in range(count):
        out.append(T)
        T = T @ se3.make(se3.exp_rotation(rng.normal(0, 0.5, 3)), rng.normal(0, 2, 3))
    return out


def test_what_is_sent_without_gaps_stays_as_it_is() -> None:
    relay, rng = KeyframeRelay(), np.random.default_rng(1)
    for number, T in enumerate(poses(rng, 5)):
        one = keyframe(number, 0, number - 1 if number else None, T, 0.01)
        assert relay.sent(one) is one


def test_a_gap_is_bridged_with_the_covariance_of_the_whole_way() -> None:
    """Expected: the covariance of sampled noisy chains, which know nothing of adjoints, to 5 per cent."""
    relay, rng = KeyframeRelay(), np.random.default_rng(2)
    T = poses(rng, 4)
    chain = [keyframe(n, 0, n - 1 if n else None, T[n], 0.002 * (n + 1)) for n in range(4)]
    relay.sent(chain[0])
    relay.left_out(chain[1])
    relay.left_out(chain[2])
    bridged = relay.sent(chain[3])
    assert bridged.previous_id == 0 and bridged.id == 3
    errors = np.empty((SAMPLES, 6))
    truth = se3.inverse(T[0]) @ T[3]
    for sample in range(SAMPLES):
        noisy = np.eye(4)
        for n in (1, 2, 3):
            noise = rng.normal(0, np.sqrt(np.diag(chain[n].covariance)))  # type: ignore[arg-type]
            noisy = noisy @ se3.inverse(T[n - 1]) @ T[n] @ se3.make(se3.exp_rotation(noise[:3]), noise[3:])
        error = se3.inverse(truth) @ noisy
        skew = (error[:3, :3] - error[:3, :3].T) / 2
        errors[sample] = (skew[2, 1], skew[0, 2], skew[1, 0], *error[:3, 3])
    sampled = errors.T @ errors / SAMPLES
    assert bridged.covariance is not None
    np.testing.assert_allclose(bridged.covariance, sampled, atol=0.05 * np.abs(sampled).max())


def test_a_session_whose_beginning_is_left_out_begins_later() -> None:
    relay, rng = KeyframeRelay(), np.random.default_rng(3)
    T = poses(rng, 4)
    relay.sent(keyframe(0, 0, None, T[0], 0.01))
    relay.left_out(keyframe(1, 1, None, T[1], 0.01))
    later = relay.sent(keyframe(2, 1, 1, T[2], 0.01))
    assert later.previous_id is None
    following = keyframe(3, 1, 2, T[3], 0.01)
    assert relay.sent(following) is following
