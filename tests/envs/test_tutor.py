"""The simulated tutor: Gymnasium's contract, one student as many, the student model, the gain, the features."""

import doctest
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import oat_gym.envs
from oat_gym.envs import TUTOR_ID, _tutor_log, _tutor_model, tutor
from oat_gym.envs._tutor_log import N_DRAWS, Session, record, work_through
from oat_gym.envs._tutor_model import (
    ISOMORPHIC,
    N_PRINCIPLES,
    N_PROBLEMS,
    POST_ITEMS,
    PROBLEMS,
    SOLVE,
    STUDY,
    TOGETHER,
    Students,
    attention_after,
    draw_students,
    normalized_learning_gain,
    score,
    teaching,
)
from oat_gym.envs.tutor import FEATURE_GROUPS, FEATURES, Classroom, TutorEnv, TutorVectorEnv
from oat_gym.errors import ConfigurationError, InvalidDataError

oat_gym.envs.register()
N = 400


def some_students(n=N, *, seed=0):
    rng = np.random.default_rng(seed)
    return draw_students(rng.standard_normal((n, _tutor_model.N_NORMALS)), rng.random((n, _tutor_model.N_UNIFORMS)))


def taught(actions, *, n=N, seed=0):
    """Return the outcomes before and after every problem; `actions` are 12 numbers or (12, n)."""
    room = Classroom([np.random.default_rng([seed, number]) for number in range(n)])
    seen = [room.outcome()]
    for action in actions:
        room.work(np.broadcast_to(action, n).astype(np.int64))
        seen.append(room.outcome())
    return seen


def feature(outcome, name):
    return outcome.observations[:, FEATURES.index(name)].astype(np.float64)


def test_gymnasiums_checker_is_content():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(TUTOR_ID).unwrapped)
    envs = gym.make_vec(TUTOR_ID, num_envs=3)
    assert isinstance(envs.unwrapped, TutorVectorEnv)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert envs.observation_space.contains(envs.reset(seed=0)[0])


@pytest.mark.parametrize("seed", [5, [9, 2, 2]])
def test_many_students_are_the_same_as_one_by_one_resets_included(seed):
    """SyncVectorEnv of three TutorEnv is the reference; 30 steps go through two automatic resets."""
    reference, envs = SyncVectorEnv([TutorEnv] * 3), TutorVectorEnv(3)
    pairs = [(reference.reset(seed=seed), envs.reset(seed=seed))]
    actions = np.random.default_rng(0).integers(0, 3, (30, 3))
    pairs += [(reference.step(action), envs.step(action)) for action in actions]
    for one, two in pairs:
        for left, right in zip(one[:-1], two[:-1], strict=True):
            np.testing.assert_array_equal(left, right)
        np.testing.assert_array_equal(one[-1]["time"], two[-1]["time"])
    ended = [pair[1][2].all() for pair in pairs[1:]]
    assert [number + 1 for number, end in enumerate(ended) if end] == [12, 25]


def test_a_student_does_not_depend_on_the_others():
    alone, many = TutorVectorEnv(1), TutorVectorEnv(300)
    first, all_of = alone.reset(seed=[250])[0], many.reset(seed=list(range(300)))[0]
    np.testing.assert_array_equal(first[0], all_of[250])
    for step in range(12):
        actions = np.random.default_rng(step).integers(0, 3, 300)
        one, whole = alone.step(actions[[250]]), many.step(actions)
        np.testing.assert_array_equal(one[0][0], whole[0][250])
        assert one[1][0] == whole[1][250]


def test_the_step_after_the_last_begins_anew_and_ignores_the_action():
    envs, other = TutorVectorEnv(4), TutorVectorEnv(4)
    start = envs.reset(seed=0)[0]
    other.reset(seed=0)
    for _ in range(12):
        *_, terminated, _, infos = envs.step(np.full(4, 2))
        other.step(np.full(4, 2))
    assert terminated.all()
    assert infos["_posttest"].all()
    observations, rewards, terminated, truncated, infos = envs.step(np.full(4, 0))
    np.testing.assert_array_equal(observations, other.step(np.full(4, 1))[0])
    assert not rewards.any()
    assert not (terminated | truncated).any()
    assert not infos["time"].any()
    assert "posttest" not in infos
    assert (observations[:, FEATURES.index("problems_done")] == 0).all()
    assert not np.array_equal(observations, start)  # new students
    np.testing.assert_array_equal(envs.reset(seed=0)[0], start)


def test_wrong_calls_are_refused():
    env, envs = TutorEnv(), TutorVectorEnv(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.zeros(2, dtype=int))
    env.reset(seed=0)
    envs.reset(seed=0)
    for bad in (np.array([0, 3]), np.array([0.0, 1.0]), np.array([1])):
        with pytest.raises(InvalidDataError, match="whole numbers from 0 to 2"):
            envs.step(bad)
    with pytest.raises(InvalidDataError):
        env.step(-1)
    with pytest.raises(ConfigurationError, match="3 seeds for 2"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigurationError, match="at least 1"):
        TutorVectorEnv(0)
    for _ in range(12):
        env.step(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(2)


def test_the_learning_gain_is_the_papers():
    pre, post = np.array([0.0, 0.19, 0.75, 0.5]), np.array([0.4, 0.19, 1.0, 0.25])
    np.testing.assert_allclose(normalized_learning_gain(pre, post), [0.4, 0.0, 0.5, -0.25 / np.sqrt(0.5)])
    for bad in ((1.0, 1.0), (-0.1, 0.5), (0.5, 1.1), (np.nan, 0.5)):
        with pytest.raises(InvalidDataError):
            normalized_learning_gain(np.array([bad[0]]), np.array([bad[1]]))


def test_the_reward_is_the_gain_of_the_two_tests_and_comes_last():
    seen = taught([TOGETHER] * 12)
    assert all(not outcome.rewards.any() and not outcome.done for outcome in seen[:-1])
    last = seen[-1]
    assert last.done
    np.testing.assert_array_equal(last.rewards, (last.posttest - last.pretest) / np.sqrt(1 - last.pretest))
    assert last.pretest.max() <= tutor.HIGHEST_PRETEST < 1
    np.testing.assert_allclose(feature(last, "pretest_score"), last.pretest, atol=0.5 / 14 + 1e-6)


def test_tests_measure_what_is_known():
    """Expected score: slip and guess of each principle asked, averaged over items; 14 and 20 items as in the paper."""
    assert (len(ISOMORPHIC), len(POST_ITEMS), POST_ITEMS[:14]) == (14, 20, ISOMORPHIC)
    students, known = some_students(3)
    rng = np.random.default_rng(0)
    for items in (ISOMORPHIC, POST_ITEMS):
        draws = rng.random((20_000, _tutor_model.n_applications(items)))
        one = Students(**{name: np.full(20_000, value[1]) for name, value in vars(students).items()})
        found = score(items, np.tile(known[1], (20_000, 1)), one, draws)
        right = np.where(known[1], 1 - students.slip[1], students.guess[1])
        expected = np.array([right[list(item)].mean() for item in items])
        np.testing.assert_allclose(found.mean(axis=0), expected, atol=4 * 0.5 / np.sqrt(20_000))


def test_learning_is_the_bayesian_knowledge_tracing_transition():
    """P(known after one step) = 1 - (1 - P(T)) for unknown principles; known ones stay known."""
    n = 40_000
    students = Students(*(np.full(n, value) for value in (0.2, 0.25, 0.05, 1.0, 0.5, 0.5)))
    known = np.zeros((n, N_PRINCIPLES), dtype=bool)
    known[:, 3] = True
    draws = np.random.default_rng(0).random((n, 4, N_DRAWS))
    problem = (3, 0, 0, 1)  # a quarter of the steps is known
    for action in (SOLVE, STUDY, TOGETHER):
        chosen = np.full(n, action)
        after = work_through(problem, chosen, students=students, known=known, attention=np.full(n, 0.8), draws=draws)[1]
        p = 0.2 * 0.8 * teaching(np.array([action]), np.array([0.25]))[0]
        np.testing.assert_allclose(after[:, 1].mean(), p, atol=4 * 0.5 / np.sqrt(n))
        np.testing.assert_allclose(after[:, 0].mean(), 1 - (1 - p) ** 2, atol=4 * 0.5 / np.sqrt(n))
        assert after[:, 3].all()
        assert not after[:, [2, 4, 5, 6, 7, 8, 9]].any()
    assert not known[:, 0].any()  # the argument is as it was


def test_answers_slip_and_are_guessed():
    n = 40_000
    students = Students(*(np.full(n, value) for value in (1e-9, 0.25, 0.05, 1.0, 0.5, 0.5)))
    known = np.zeros((n, N_PRINCIPLES), dtype=bool)
    known[:, 3] = True
    draws = np.random.default_rng(1).random((n, 2, N_DRAWS))
    work = work_through((3, 0), np.full(n, SOLVE), students=students, known=known, attention=np.ones(n), draws=draws)[0]
    np.testing.assert_allclose(work.correct.mean(axis=0), [0.95, 0.25], atol=4 * 0.5 / np.sqrt(n))
    wrong = ~work.correct
    np.testing.assert_allclose((work.hints > 0)[wrong].mean(), 0.5, atol=0.02)
    assert not work.hints[~wrong].any()
    assert (work.attempts[~wrong] == 1).all()
    assert (work.attempts[wrong] >= 2).all()


@pytest.mark.parametrize("action", [SOLVE, STUDY, TOGETHER])
def test_nothing_is_forgotten_and_practice_raises_mastery(action):
    mastery = np.stack([outcome.mastery for outcome in taught([action] * 12)])
    assert (np.diff(mastery, axis=0) >= 0).all()
    assert (np.diff(mastery.mean(axis=1)) > 0).all()


def test_students_of_higher_learning_rate_learn_more():
    rng = np.random.default_rng(0)
    draws = rng.random((N, len(PROBLEMS[-1]), N_DRAWS))
    slow, known = some_students()
    quick = Students(**{**vars(slow), "learning": np.minimum(1.5 * slow.learning, 1.0)})
    options = {"known": known, "attention": np.ones(N), "draws": draws}
    few = work_through(PROBLEMS[-1], np.zeros(N, dtype=int), students=slow, **options)[1]
    more = work_through(PROBLEMS[-1], np.zeros(N, dtype=int), students=quick, **options)[1]
    assert (more >= few).all()
    assert more.sum() > few.sum()


def test_the_best_way_depends_on_the_student():
    """Aptitude-treatment interaction: examples suit novices, solving suits the advanced, both tire in their way."""
    ready = np.linspace(0, 1, 101)
    strength = np.stack([teaching(np.full(101, action), ready) for action in range(3)])
    best = strength.argmax(axis=0)
    assert (strength > 0).all()
    assert (best[ready < 0.3] == STUDY).all()
    assert (best[ready > 0.6] == SOLVE).all()
    assert set(best) == {SOLVE, STUDY, TOGETHER}
    gains = {action: taught([action] * 12, n=3000)[-1] for action in (SOLVE, STUDY)}
    low = gains[SOLVE].pretest < 0.3
    high = gains[SOLVE].pretest > 0.6
    assert gains[STUDY].mastery[low].mean() > gains[SOLVE].mastery[low].mean() + 0.05
    assert gains[SOLVE].mastery[high].mean() > gains[STUDY].mastery[high].mean() + 0.05


def test_attention_falls_by_reading_and_failing_and_stays_in_its_range():
    action, wrong = np.array([STUDY, SOLVE, SOLVE, TOGETHER]), np.array([0.0, 0.5, 0.4, 0.6])
    np.testing.assert_allclose(attention_after(np.full(4, 0.7), action, wrong), [0.5, 0.5, 0.9, 0.5])
    np.testing.assert_allclose(attention_after(np.array([0.45, 0.95]), np.array([1, 0]), np.zeros(2)), [0.4, 1.0])


def test_parameters_are_in_the_published_ranges_and_students_differ():
    students, known = some_students(5000)
    assert 0.1 <= students.guess.min() < students.guess.max() <= 0.3
    assert 0.02 <= students.slip.min() < students.slip.max() <= 0.1
    assert students.pace.min() >= 0.4
    assert students.pace.max() <= 2.5
    assert np.quantile(students.learning, 0.9) > 2 * np.quantile(students.learning, 0.1)
    share = known.mean(axis=0)
    assert (np.diff(share[[0, 3, 6, 9]]) < 0).all()  # harder principles are known by fewer
    assert known.mean(axis=1).std() > 1.3 * np.sqrt((share * (1 - share)).sum()) / N_PRINCIPLES  # aptitude


def test_features_come_in_the_papers_five_groups():
    sizes = {group: len(names) for group, names in FEATURE_GROUPS.items()}
    assert sizes == {
        "autonomy": 10,
        "temporal situation": 29,
        "problem solving": 35,
        "performance": 57,
        "hints": 11,
    }
    assert len(FEATURES) == len(set(FEATURES)) == 142
    for name, group in (("restarts", "autonomy"), ("seconds_per_step", "temporal situation")):
        assert name in FEATURE_GROUPS[group]  # the paper's examples
    for name, group in (("difficulty", "problem solving"), ("correct_share", "performance"), ("hints", "hints")):
        assert name in FEATURE_GROUPS[group]


def test_observations_stay_in_the_space():
    space = tutor.observation_space()
    rng = np.random.default_rng(0)
    for outcome in taught(rng.integers(0, 3, (12, N))):
        assert (outcome.observations >= space.low).all()
        assert (outcome.observations <= space.high).all()
        assert outcome.observations.dtype == np.float32


def test_features_are_what_the_log_of_steps_says():
    """Counts and times of the features against sums over the recorded steps, for a mix of actions."""
    rng = np.random.default_rng(3)
    students, known = some_students()
    session, works = Session.empty(N), []
    actions = rng.integers(0, 3, (N_PROBLEMS, N))
    for problem, action in zip(PROBLEMS, actions, strict=True):
        draws = rng.random((N, len(problem), N_DRAWS))
        options = {"students": students, "known": known, "attention": np.ones(N), "draws": draws}
        work, known = work_through(problem, action, **options)
        session = record(session, work, action)
        works.append(work)
    desk = tutor.Desk(session, np.zeros((N, 14)), np.ones(N), np.ones(N), done=N_PROBLEMS)
    found = {name: column for part in tutor.describe(desk).values() for name, column in part.items()}
    asked = sum(work.elicited.sum(axis=1) for work in works)
    correct = sum(work.correct.sum(axis=1) for work in works)
    seconds = sum(work.seconds.sum(axis=1) for work in works)
    steps = sum(map(len, PROBLEMS))
    np.testing.assert_array_equal(found["steps_done"], asked)
    np.testing.assert_array_equal(found["steps_told"], steps - asked)
    np.testing.assert_array_equal(found["correct"] + found["wrong"], asked)
    np.testing.assert_allclose(found["correct_share"], correct / np.maximum(asked, 1))
    np.testing.assert_array_equal(found["session_seconds"], seconds)
    np.testing.assert_allclose(found["seconds_per_step"], seconds / steps)
    np.testing.assert_array_equal(found["hints"], sum(work.hints.sum(axis=1) for work in works))
    np.testing.assert_array_equal(found["restarts"], sum(work.restarted for work in works))
    np.testing.assert_array_equal(found["hints_last"], works[-1].hints.sum(axis=1))
    np.testing.assert_array_equal(found["longest_step"], np.max([work.seconds.max(axis=1) for work in works], axis=0))
    np.testing.assert_array_equal(found["shortest_step"], np.min([work.seconds.min(axis=1) for work in works], axis=0))
    for number, name in enumerate(tutor.ACTIONS):
        np.testing.assert_array_equal(found[f"problems_{name}"], (actions == number).sum(axis=0))
        of_kind = sum(work.seconds.sum(axis=1) * (a == number) for work, a in zip(works, actions, strict=True))
        np.testing.assert_array_equal(found[f"seconds_{name}"], of_kind)
        np.testing.assert_array_equal(found[f"last_was_{name}"], actions[-1] == number)
    for principle in (0, 9):
        name = _tutor_model.PRINCIPLES[principle]
        expected = sum(
            work.correct[:, step] for work in works for step, k in enumerate(work.principles) if k == principle
        )
        np.testing.assert_array_equal(found[f"correct_{name}"], expected)
        np.testing.assert_array_equal(found[f"seen_{name}"], sum(problem.count(principle) for problem in PROBLEMS))
    assert not found["difficulty"].any()  # no problem is left
    assert sum(part.sum() for part in found.values()) > 0


def test_streaks_count_first_answers_in_a_row():
    elicited = np.array([[1, 1, 0, 1, 1, 1]], dtype=bool)
    correct = np.array([[1, 1, 0, 0, 1, 0]], dtype=bool)
    hints = np.array([[0, 0, 0, 3, 0, 0]])
    zeros = np.zeros_like(hints)
    work = _tutor_log.Work((0,) * 6, elicited, correct, zeros, hints, zeros + 1, zeros, np.zeros(1, dtype=bool))
    session = record(Session.empty(1), work, np.array([SOLVE]))
    assert session.streaks[:, 0].tolist() == [0, 1, 2, 0]  # right now, wrong now, longest right, without hint
    again = record(session, work, np.array([SOLVE]))
    assert again.streaks[:, 0].tolist() == [0, 1, 2, 0]
    assert (again.repeated[0], session.repeated[0]) == (2, 1)


def test_examples_without_answers_and_solving_without_telling():
    study, solve = taught([STUDY] * 12)[-1], taught([SOLVE] * 12)[-1]
    for name in ("steps_done", "correct", "wrong", "hints", "answering_seconds", "retries"):
        assert not feature(study, name).any()
    assert not feature(solve, "steps_told").any()
    assert (feature(solve, "done_share") == 1).all()
    assert (feature(solve, "same_in_a_row") == 12).all()


def test_no_knowledge_leaks_into_the_first_observation():
    """Before the first problem students differ in the pre-test and in its and the textbook's time alone."""
    first = taught([])[0]
    constant = np.ptp(first.observations, axis=0) == 0
    varying = {name for name, same in zip(FEATURES, constant, strict=True) if not same}
    pretest = {f"pretest_{name}" for name in _tutor_model.PRINCIPLES}
    assert varying == {"pretest_score", "reading_seconds", "pretest_seconds"} | pretest


@pytest.mark.parametrize("module", [tutor, _tutor_model, oat_gym.envs])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0
