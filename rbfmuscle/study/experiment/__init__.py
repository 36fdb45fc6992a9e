"""Many runs or fits side by side: comparisons, sweeps, kernels."""
