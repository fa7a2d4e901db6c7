"""What answers other processes over WebSockets: ``executor_server`` the executor, and ``fleet`` builds on the same.

``admission`` and ``lock`` say who may come in, ``listener`` reads and answers, ``protocol`` and ``metrics`` have the
formats.
"""
