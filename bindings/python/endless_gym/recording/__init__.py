"""Records episodes of scripted experts, random play or an agent as a Minari data set.

| module | content |
| --- | --- |
| `chunks` | arrays that are compressed while they grow |
| `players` | the policies that choose the actions |
| `episodes` | plays episodes, many at a time |
| `dataset` | writes a Minari data set |
| `recorder` | `record`, which combines them |
| `command` | `endless record` |
"""

from endless_gym.recording.recorder import Recording, record

__all__ = ["Recording", "record"]
