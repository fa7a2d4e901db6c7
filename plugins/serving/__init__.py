"""What answers other processes over WebSockets: ``executor_server`` the executor, ``fleet`` many robots with copies.

``openpi`` is a fleet of one policy that speaks openpi's protocol. ``admission`` and ``lock`` say who may come in,
``listener`` reads and answers, ``protocol`` has the formats, and ``command`` is ``ttscompile serve``.
"""
