"""From a capture to an articulated object: the stages, their losses, and the events that they yield.

Nothing is imported here: the command line reads the presets from `schedule`, and must not wait for torch.
"""
