"""What a run took, stages that ran side by side counted once."""

import json

from p2gs.stage_times import note_stage, stages_file, wall_seconds


def test_stages_side_by_side_count_by_the_longer(tmp_path):
    note_stage(tmp_path, "single_state_0", 40.0, 600)
    note_stage(tmp_path, "single_state_1", 50.0, 610, beside="single_state_0")
    note_stage(tmp_path, "discovery", 30.004, 900)
    stages = json.loads(stages_file(tmp_path).read_text())
    assert stages["discovery"] == {"seconds": 30.0, "peak_memory_mib": 900}
    assert wall_seconds(stages) == 80.0
    note_stage(tmp_path, "single_state_1", 30.0, 610, beside="single_state_0")
    assert wall_seconds(json.loads(stages_file(tmp_path).read_text())) == 70.0
    del stages["single_state_0"]  # taken over from elsewhere, say
    assert wall_seconds(stages) == 80.0
