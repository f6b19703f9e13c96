"""What is integrated out: linear Gaussian states, and parameters with conjugate distributions."""
