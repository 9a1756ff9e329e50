"""The demo: a server, a simulator and several agents as processes; one robot is lost and finds its way."""
