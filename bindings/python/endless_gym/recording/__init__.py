"""Episodes of scripted experts, of random play or of an agent, as a Minari data set.

| module | content |
| --- | --- |
| `chunks` | arrays that are compressed while they grow |
| `players` | what chooses the actions |
| `episodes` | plays episodes, many at a time |
| `dataset` | writes a Minari data set |
| `recorder` | `record`: all of it |
| `command` | `endless record` |
"""

from endless_gym.recording.recorder import Recording, record

__all__ = ["Recording", "record"]
