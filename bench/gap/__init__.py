"""The blind benchmark of `ssm.diagnose`: systems, withheld effects, rivals and scoring."""
