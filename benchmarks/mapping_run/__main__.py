"""`python -m benchmarks.mapping_run`."""

from benchmarks.mapping_run.benchmark import main

if __name__ == "__main__":
    main()
