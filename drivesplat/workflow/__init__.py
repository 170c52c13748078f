"""What the rules ask: plan, stages, inputs, jobs, GPUs and measured costs."""

import os
import sys

if hasattr(sys.modules["__main__"], "snakemake"):  # in a rule's script, which imports this before numpy
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    """Stages have threads of their own. Snakemake asks OpenBLAS for as many again, which then wait actively for small
    products of matrices: 20 % of the processor time of `masks` with two threads."""
