"""The library behind the table of results.

``cases``, ``precisions``, ``robots``, ``shapes`` and ``arms`` are the scenes and operations. ``runner`` checks and
times them, with ``resources``, ``roofline`` and ``operation_counts``. ``parts`` names all of it, ``process_turns``
gives the machine to one process at a time, ``occupied_gpu`` leaves a part of a GPU. ``table``, ``pictures`` and
``evidence`` make pages of the rows; ``commits`` and ``probe`` compare commits.
"""
