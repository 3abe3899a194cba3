"""Recordings for the Rerun viewer and the live view; nothing else in streamtrack talks to Rerun.

`recorder.Recorder` writes a run's recording, `live_view.LiveView` shows it as it goes; both log
through `steps`. `blueprint` names the entities and lays the viewer out, `series` and `repair` look
after recordings in parts, `pictures` records mosaics of pictures.
"""
