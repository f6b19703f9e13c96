"""The experiment that would tell rival effects apart: signals for an input, and the best one."""
