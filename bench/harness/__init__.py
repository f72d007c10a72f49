"""What every table of the benchmark needs: the machine, children, samples, and the printed result.

Standard library only, so that a figure never depends on what else is installed.
"""
