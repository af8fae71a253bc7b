"""Records episodes of scripted experts, random play or an agent as a Minari data set."""

from endless_gym.recording.recorder import Recording, record

__all__ = ["Recording", "record"]
