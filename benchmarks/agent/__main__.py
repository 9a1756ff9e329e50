"""`python -m benchmarks.agent`."""

from benchmarks.agent.benchmark import main

if __name__ == "__main__":
    main()
