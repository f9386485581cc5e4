"""Games of TextWorld: generated, compiled, and explored state by state.

A state of a game is its set of facts. TextWorld's own logic gives the facts and the admissible commands, and the compiled game, played
by a Z-machine, gives the texts. Both must agree on which commands win. What was explored is stored, because it takes minutes.

It needs `pip install textworld`, whose wheel for Linux has the compiler of the games (Inform 7).
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import count, islice
from pathlib import Path
from typing import Any

__all__ = ["Command", "ExploredGame", "GameRules", "load_games"]

MIN_STATES, MAX_STATES = 20, 800
END = "*** The End ***"
WITHOUT_EFFECT = ("examine", "look", "inventory")
"""Verbs of commands that leave the facts as they are."""


@dataclass(frozen=True)
class GameRules:
    """What a game is generated from. There is one for each seed."""

    seed: int
    n_rooms: int
    n_objects: int
    quest_length: int


@dataclass(frozen=True)
class Command:
    """An admissible command of a state."""

    text: str
    result: int
    """The index of what the game answers in `ExploredGame.texts`."""
    next_state: int


@dataclass(frozen=True)
class ExploredGame:
    """All states of a game that can be reached. The first one is the start."""

    rules: GameRules
    objective: str
    texts: list[str]
    room: list[str]
    """Of each state."""
    won: list[bool]
    commands: list[list[Command]]
    """Of each state; none of a state that is won."""


def load_games(directory: Path, n_games: int) -> list[ExploredGame]:
    """Return the first games whose number of states is in the range. Those that are not in the directory are made.

    Raises:
        SystemExit: TextWorld is not installed.
    """
    directory.mkdir(parents=True, exist_ok=True)
    return list(islice(_games(directory), n_games))


def _games(directory: Path) -> Iterator[ExploredGame]:
    for seed in count():
        path = directory / f"explored-{seed}.json"
        if not path.exists():
            rules = GameRules(seed, n_rooms=3 + seed % 2, n_objects=4, quest_length=4 + seed % 3)
            game = make_game(rules, directory)
            path.write_text(json.dumps(game and asdict(game)))
        if (stored := json.loads(path.read_text())) is not None:
            yield _read_game(stored)


def _read_game(stored: dict[str, Any]) -> ExploredGame:
    commands = [[Command(**command) for command in row] for row in stored["commands"]]
    return ExploredGame(**{**stored, "rules": GameRules(**stored["rules"]), "commands": commands})


def make_game(rules: GameRules, directory: Path) -> ExploredGame | None:
    """Generate a game, compile it into a directory and explore it. None if it has too few or too many states."""
    try:
        import textworld
        from textworld.generator import compile_game
        from textworld.generator import make_game as generate
    except ImportError:
        raise SystemExit("the games need TextWorld: pip install textworld") from None
    options = textworld.GameOptions()
    options.seeds = rules.seed
    options.nb_rooms, options.nb_objects = rules.n_rooms, rules.n_objects
    options.quest_length = rules.quest_length
    options.grammar.only_last_action = True  # of the quest, in the objective
    options.path = str(directory / f"game-{rules.seed}.z8")
    game = generate(options)
    if not MIN_STATES <= _count_states(game) <= MAX_STATES:
        return None
    return explore(rules, game, compile_game(game, options))


def _start(game: Any) -> tuple[Any, Any]:
    from textworld.generator.game import GameProgression
    from textworld.generator.inform7 import Inform7Game

    return GameProgression(game, track_quests=True), Inform7Game(game)


def _choices(progress: Any, inform: Any) -> dict[str, Any]:
    """Return the admissible commands of a state, in the order of the alphabet, and what they mean."""
    actions = progress.valid_actions
    return dict(sorted(zip(inform.gen_commands_from_actions(actions), actions, strict=True)))


def _after(progress: Any, action: Any) -> Any:
    following = progress.copy()
    following.update(action)
    return following


def _count_states(game: Any) -> int:
    """Return the number of states, or `MAX_STATES` + 1 if there are more."""
    progress, inform = _start(game)
    facts, queue = {frozenset(progress.state.facts)}, [progress]
    for progress in queue:
        if progress.completed:
            continue
        for command, action in _choices(progress, inform).items():
            if command.split()[0] in WITHOUT_EFFECT:
                continue
            following = _after(progress, action)
            if (key := frozenset(following.state.facts)) not in facts:
                facts.add(key)
                queue.append(following)
                if len(facts) > MAX_STATES:
                    return len(facts)
    return len(facts)


def explore(rules: GameRules, game: Any, story_file: str) -> ExploredGame:
    """Give every admissible command in every state.

    Raises:
        AssertionError: the Z-machine and TextWorld's logic disagree on whether a command wins.
    """
    import warnings

    import jericho

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jericho.UnsupportedGameWarning)
        machine = jericho.FrotzEnv(story_file)
    machine.reset()
    progress, inform = _start(game)
    index, queue = {frozenset(progress.state.facts): 0}, [(progress, machine.get_state())]
    texts: dict[str, int] = {}
    room, won, commands = [], [], []
    for progress, saved in queue:
        room.append(next(str(fact) for fact in progress.state.facts if fact.name == "at" and fact.names[0] == "P"))
        won.append(bool(progress.completed))
        row = []
        for command, action in {} if progress.completed else _choices(progress, inform).items():
            machine.set_state(saved)
            text = _clean(machine.step(command)[0])
            following = _after(progress, action)
            assert bool(following.completed) == (END in text), f"game {rules.seed}: {command!r} answers {text!r}"
            key = frozenset(following.state.facts)
            if key not in index:
                index[key] = len(index)
                queue.append((following, machine.get_state()))
            row.append(Command(command, texts.setdefault(text, len(texts)), index[key]))
        commands.append(row)
    machine.close()
    return ExploredGame(rules, game.objective, list(texts), room, won, commands)


def _clean(text: str) -> str:
    """Return a game's answer without its prompt and its line of status."""
    return text.partition("\n>")[0].strip()
