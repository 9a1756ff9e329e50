"""`python -m benchmarks.own_map`."""

from benchmarks.own_map.benchmark import main

if __name__ == "__main__":
    main()
