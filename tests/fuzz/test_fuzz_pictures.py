"""Random scenes whose pictures are known are right, and would be found if they were not."""

from dataclasses import replace

from fuzz import pictures


def test_random_scenes_are_right(monkeypatch, capsys):
    monkeypatch.setitem(pictures.SPP, "pair", 16)
    assert pictures.main(["--first", "2", "--count", "2"]) == 0
    assert "4 scenes: 0 wrong" in capsys.readouterr().out


def test_a_furnace_that_loses_light_is_found(monkeypatch, tmp_path):
    maker = pictures.Maker(0, 0, tmp_path)
    scene, level = maker.furnace()
    darker = replace(scene, lights=(pictures.ConstantLight((1.0, 1.0, 1.0 - 1e-8)),))
    monkeypatch.setattr(maker, "furnace", lambda: (darker, level))
    assert "off by 1e-08" in pictures.wrong_furnace(maker)


def test_a_body_that_absorbs_more_as_a_mesh_is_found(monkeypatch, tmp_path):
    maker = pictures.Maker(0, 0, tmp_path)
    exact, meshes, level = maker.pair()
    more = tuple(
        replace(medium, grains=(replace(medium.grains[0], absorption=pictures.Absorption("grey", (0.5,))),))
        for medium in meshes.media
    )
    monkeypatch.setattr(maker, "pair", lambda: (exact, replace(meshes, media=more), level))
    assert "standard errors" in pictures.wrong_pair(maker)
