"""Open an axis, move it, wait, read it: the shortest useful program."""

import sioms


def main() -> None:
    with sioms.Workcell() as cell, cell.open("mod0.xaxis", "rw") as axis:
        print("before:", axis.read().position[0], axis.info.channels[0].unit)
        axis.move(0.10)
        axis.wait_until_idle(timeout=5.0)
        print("after: ", axis.read().position[0])
        try:
            axis.move(9.0)
        except OSError as error:  # a refused command moves nothing and says why
            print("refused:", error.strerror)
        axis.move(0.0)
        axis.wait_until_idle(timeout=5.0)


if __name__ == "__main__":
    main()
