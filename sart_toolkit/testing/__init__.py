"""What backends and tasks promise, as a test suite for yours, in this repository or outside it.

    pytest --pyargs sart_toolkit.testing --sart-backend my_package.my_module:MyBackend

runs it with two of our robots, or with those named by `--sart-robot`.

    pytest --pyargs sart_toolkit.testing --sart-task path/to/my_task.py:MyTask

tests a task, in the default simulator with its own robot, or on what `--sart-backend` and
`--sart-robot` name.
Without options our own `BACKENDS` and `TASKS` are tested.

Tests of an ability that the backend lacks are skipped. `-rs` says why a test was skipped: "not
judged before test_… passes" means that that one has to be fixed first.

Needs pytest: `pip install 'sart_toolkit[testing]'`.
"""
