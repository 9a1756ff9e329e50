"""`python -m benchmarks.life_year`."""

from benchmarks.life_year.benchmark import main

if __name__ == "__main__":
    main()
