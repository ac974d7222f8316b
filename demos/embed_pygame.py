"""A walkable scene in a pygame window: python -m demos.embed_pygame [DIR].

Arrow keys or WASD walk and turn, Esc closes. The window, its context and its events are pygame's; the runtime is only
ever given the context. With --frames N it walks by itself for N frames (and --out FILE.png keeps the last).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import moderngl

from demos.embedding import Scripted, parse_arguments, save_picture
from demos.errors import DemoError
from demos.extras import needs_packages
from demos.options import run
from demos.walk_scene import WalkScene

with needs_packages(__name__, "embed_pygame"):
    import pygame


def open_window(size: tuple[int, int]) -> None:
    """A window with an OpenGL 4.1 core context, current."""
    pygame.display.init()
    attributes = {
        pygame.GL_CONTEXT_MAJOR_VERSION: 4,
        pygame.GL_CONTEXT_MINOR_VERSION: 1,
        pygame.GL_CONTEXT_PROFILE_MASK: pygame.GL_CONTEXT_PROFILE_CORE,
        pygame.GL_CONTEXT_FLAGS: pygame.GL_CONTEXT_FORWARD_COMPATIBLE_FLAG,
        pygame.GL_DEPTH_SIZE: 24,
        pygame.GL_MULTISAMPLEBUFFERS: 1,
        pygame.GL_MULTISAMPLESAMPLES: 4,
    }
    for attribute, value in attributes.items():
        pygame.display.gl_set_attribute(attribute, value)
    try:
        pygame.display.set_mode(size, pygame.OPENGL | pygame.DOUBLEBUF | pygame.RESIZABLE)
    except pygame.error as error:
        raise DemoError(f"pygame cannot open a window with OpenGL 4.1 ({error}): update the graphics driver") from None
    pygame.display.set_caption("seamskin in pygame")


def steer(scene: WalkScene) -> None:
    """Keys to directions."""
    pressed = pygame.key.get_pressed()

    def down(*keys: int) -> int:
        return int(any(pressed[key] for key in keys))

    forward = down(pygame.K_UP, pygame.K_w) - down(pygame.K_DOWN, pygame.K_s)
    scene.steer(forward, down(pygame.K_LEFT, pygame.K_a) - down(pygame.K_RIGHT, pygame.K_d))


def closed() -> bool:
    """Whether the player has had enough."""
    return any(
        event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE)
        for event in pygame.event.get()
    )


def play(arguments: Sequence[str] | None) -> None:
    """The game loop."""
    options = parse_arguments("python -m demos.embed_pygame", arguments)
    open_window(options.size)
    try:
        ctx = moderngl.create_context()  # wraps pygame's context
        scene = WalkScene(ctx, options.folder)
        scripted = Scripted(options.frames)
        clock = pygame.time.Clock()
        while not closed():
            steer(scene)
            scene.update(scripted.next_step(scene, clock.tick() / 1000))
            screen = ctx.detect_framebuffer()
            screen.viewport = (0, 0, *pygame.display.get_window_size())
            scene.draw(screen)
            if scripted.finished:
                save_picture(options.out, screen)
                break
            pygame.display.flip()
        scene.release()
        ctx.release()
    finally:
        pygame.display.quit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of `python -m demos.embed_pygame`."""
    return run("embed_pygame", lambda: play(arguments))


if __name__ == "__main__":
    sys.exit(main())
