"""Figures drawn by two processes are those drawn by one, also when the other process is killed."""

import multiprocessing

from thermostand.compensation.reporting.drawing.figures import create_figure, open_renderer, render_in_turn


def test_two_processes_draw_the_same_bytes():
    figures = []
    for number in range(5):
        figure, (panel,) = create_figure(3, 2, 1, 1)
        panel.plot([0, 1, number])
        figures.append((figure, f"figure-{number}"))
    expected = render_in_turn(figures)
    with open_renderer(2) as draw:
        assert draw(figures) == expected
        for child in multiprocessing.active_children():
            child.kill()
        assert draw(figures) == expected
    with open_renderer(1) as draw:
        assert draw is render_in_turn
