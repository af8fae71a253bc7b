"""The reset parameters of running episodes and of the next ones."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from endless_gym import _native
from endless_gym.arguments import mappings
from endless_gym.specs import options_text

Options = Mapping[str, Any]

_NONE: Options = {}
#: The text of options that are not known, such as those of a snapshot.
_UNKNOWN = ""


class RunningEpisode(NamedTuple):
    """The seed and the options of an environment's running episode."""

    #: The seed with which the episode started; `None` if it continues the generator of the previous episode.
    seed: int | None
    #: The reset parameters given for the episode, including those given at creation; the others have their defaults.
    options: dict[str, Any]
    #: Whether the last step ended it, so that with next-step auto-reset the next step starts another.
    ended: bool


def running_episodes(backend: _native.Backend, group: int, envs: Iterable[int]) -> dict[int, RunningEpisode]:
    """Seeds and options of the running episodes of environments."""
    found = backend.running_episodes(group, list(envs))
    return {env: RunningEpisode(seed, json.loads(options), ended) for env, seed, options, ended in found}


class NextOptions:
    """The options of each environment's next episode.

    Options of the last reset override those of `set`, which override those given at creation. This class remembers the options
    that the backend's environments have, and sends only changes.
    """

    def __init__(self, backend: _native.Backend, num_envs: int, created: Sequence[Options], is_known: bool) -> None:
        """Prepare for a backend.

        `created` has one mapping for all environments, or one for each environment of all groups; `is_known` tells whether the
        backend's environments have these options.
        """
        self._backend = backend
        self._num_envs = num_envs
        self._created = [dict(each) for each in created]
        self._texts = [options_text(each) for each in self._created]
        # By group and environment, the differences from the options given at creation.
        self._set: list[dict[int, Options]] = [{} for _ in range(backend.groups)]
        self._reset: list[dict[int, Options]] = [{} for _ in range(backend.groups)]
        self._sent: list[dict[int, str]] = [{} for _ in range(backend.groups)]
        if not is_known:
            for group in range(backend.groups):
                self.forget(group, range(num_envs))

    @property
    def created(self) -> list[Options]:
        """The options given at creation for each environment of group 0."""
        return list(self._created * self._num_envs if len(self._created) == 1 else self._created[: self._num_envs])

    def forget(self, group: int, envs: Iterable[int]) -> None:
        """Treat the options of these environments as unknown until their next reset."""
        self._sent[group].update(dict.fromkeys(envs, _UNKNOWN))

    def set_all(self, groups: Sequence[int], envs: Sequence[int], options: Any) -> None:
        """Sets the options of these environments of groups, from one mapping or from a sequence, as `set_options` describes."""
        count = self._num_envs * len(groups)
        # As for seeds, a sequence has one item for each environment of a group, or of all groups.
        repeats = len(groups) if isinstance(options, Sequence) and len(options) == self._num_envs else 1
        each = mappings("options", options, count // repeats) * repeats
        for place, group in enumerate(groups):
            own = each[place * self._num_envs :][: self._num_envs]
            self.set(group, {env: given for env in envs if (given := own[env]) is not None})

    def set(self, group: int, chosen: Mapping[int, Options]) -> None:
        """Sets the options of the next episodes of environments, which override those given at creation."""
        self._send(group, self._changes(group, {env: (given, _NONE) for env, given in chosen.items()}))
        for env, given in chosen.items():
            self._reset[group].pop(env, None)
            if given:
                self._set[group][env] = given
            else:
                self._set[group].pop(env, None)

    def prepare(self, group: int, envs: Sequence[int], given: Options) -> str | None:
        """Called before a reset of these environments with these options. Returns the text that the reset must send, if any."""
        chosen, sent = self._set[group], self._sent[group]
        if not (given or chosen or sent):
            return None
        wanted = {env: (chosen.get(env, _NONE), given) for env in envs}
        changes = self._changes(group, wanted)
        if len(changes) == 1:
            ((text, changed),) = changes.items()
            if len(changed) == len(envs):
                return text
        self._send(group, changes)
        return None

    def started(self, group: int, envs: Sequence[int], given: Options, text: str | None) -> None:
        """Called after that reset."""
        if text is not None:
            self._note(group, envs, text)
        if given:
            self._reset[group].update(dict.fromkeys(envs, given))
        elif self._reset[group]:
            for env in envs:
                self._reset[group].pop(env, None)

    def _changes(self, group: int, wanted: Mapping[int, tuple[Options, Options]]) -> dict[str, list[int]]:
        """The environments whose options differ from those that the backend has, by the text of the options."""
        # Most environments share their mappings.
        texts: dict[tuple[int, int, int], str] = {}
        changes: dict[str, list[int]] = {}
        for env, (chosen, given) in wanted.items():
            number = self._number(group, env)
            key = number, id(chosen), id(given)
            text = texts.get(key)
            if text is None:
                text = texts[key] = options_text({**self._created[number], **chosen, **given})
            if text != self._sent[group].get(env, self._texts[number]):
                changes.setdefault(text, []).append(env)
        return changes

    def _send(self, group: int, changes: Mapping[str, list[int]]) -> None:
        if not changes:
            return
        items = [f'{{"options": {text}, "envs": {envs}}}' for text, envs in changes.items()]
        self._backend.set_options(group, f"[{', '.join(items)}]")
        for text, envs in changes.items():
            self._note(group, envs, text)

    def _note(self, group: int, envs: Iterable[int], text: str) -> None:
        """Remember that the backend's environments have these options."""
        sent = self._sent[group]
        for env in envs:
            if text == self._texts[self._number(group, env)]:
                sent.pop(env, None)
            else:
                sent[env] = text

    def _number(self, group: int, env: int) -> int:
        return 0 if len(self._created) == 1 else group * self._num_envs + env
