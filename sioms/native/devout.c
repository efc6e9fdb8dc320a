/* devout for the usual line: numbers of the command line to the axes or outputs of one node, without an interpreter.
 *
 * Whatever is not usual (a long option, a path, numbers from standard input, -r, -w, -H, a refusal to open, any mistake) is
 * left to the tool in Python, which is the reference: this program then becomes the command in its own arguments, before
 * it has written anything, and after it has given back what it has opened. From the write on it tells itself what happens.
 * What it shares with that tool stands before this text and attach.c: docs/decisions/0811.
 */
enum { MOST_NUMBERS = 2048, MOST_DATA = 49152, WRITE_NUMBER = 1, IDLE_NUMBER = 2 };
enum { FIRST_LOOK_MS = 1000, GRACE_MS = 2000, MOST_MS = 30000, LOOK_MS = 250 };

static struct {
    const char *name;
    struct flags flags;
    char opened[MOST_NAME + 16];
    int64_t handle, count, low, high, class;
    int daemon, sock, columns;
    const struct column *column[16];
    uint32_t mode;
} node;

static struct flags all;
static double numbers[MOST_NUMBERS];
static int64_t number_count;

/* ---- the command line ---------------------------------------------------------------------------- */

static void take_number(const char *word)
{
    char *end;
    double value = strtod(word, &end);
    if (number_count == MOST_NUMBERS || *end || number_end(word) != end || !isfinite(value) || strlen(word) > MOST_NAME)
        leave_to_python();
    numbers[number_count++] = value;
}

static void take_line(char **words)
{
    for (; *words; words++) {
        const char *word = *words;
        if (is_numeric(word)) {
            take_number(word);
        } else if (word[0] == '-' && word[1] != '-') {
            if (node.name) /* another device may follow, or none */
                for (const char *c = word + 1; *c; c++)
                    if (*c != 'W')
                        leave_to_python();
            take_group(word + 1, &node.flags, &all);
        } else {
            if (node.name || !is_plain_name(word))
                leave_to_python();
            node.name = word;
        }
    }
    for (int letter = 0; letter < 128; letter++)
        if (all.given[letter] && letter != 'W')
            leave_to_python();
    if (!node.name || !number_count)
        leave_to_python();
}

/* ---- opening, and giving back ----------------------------------------------------------------- */

/* Whether a process gets on, or has only not had its turn: state, and times that have changed. */
static int gets_on(pid_t pid)
{
    static char before[160];
    char path[64], text[1024] = "", times[160] = "";
    snprintf(path, sizeof path, "/proc/%d/stat", (int)pid);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return 0;
    ssize_t size = read(fd, text, sizeof text - 1);
    close(fd);
    char *state = size > 0 ? strrchr(text, ')') : NULL;
    if (!state || state[1] != ' ' || strchr("TtZX", state[2]))
        return 0;
    snprintf(path, sizeof path, "/proc/%d/schedstat", (int)pid);
    fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd >= 0) {
        if (read(fd, times, sizeof times - 1) < 0)
            times[0] = 0;
        close(fd);
    }
    int changed = *before && strcmp(before, times) != 0;
    memcpy(before, times, sizeof before);
    return changed || strchr("RD", state[2]) != NULL;
}

static int64_t now_ms(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000) + t.tv_nsec / 1000000;
}

/* Give the node back, and return when it is free: its axes are halting then. Returns 0 when the daemon hangs. */
static int give_back(void)
{
    uint8_t packet[sizeof CLOSE_HEAD + 9], answer[512];
    struct ucred peer = {0};
    socklen_t length = sizeof peer;
    size_t n = sizeof CLOSE_HEAD;
    shutdown(node.sock, SHUT_RDWR);
    close(node.sock);
    memcpy(packet, CLOSE_HEAD, n);
    packet[n++] = 0xCF;
    for (int shift = 56; shift >= 0; shift -= 8)
        packet[n++] = (uint64_t)node.handle >> shift;
    if (send(node.daemon, packet, n, MSG_NOSIGNAL) != (ssize_t)n)
        return 1; /* the daemon has gone; the driver has halted the axes at the end of file */
    getsockopt(node.daemon, SOL_SOCKET, SO_PEERCRED, &peer, &length);
    int64_t due = now_ms(), progress = due;
    for (;;) {
        struct pollfd ready = {node.daemon, POLLIN, 0};
        int64_t now = now_ms(), wait = now - due < FIRST_LOOK_MS ? due + FIRST_LOOK_MS - now : LOOK_MS;
        if (poll(&ready, 1, (int)wait) > 0)
            return recv(node.daemon, answer, sizeof answer, 0) <= 0 || 1;
        now = now_ms();
        if (gets_on(peer.pid))
            progress = now;
        if (now - due > MOST_MS || (now - due > GRACE_MS && now - progress > GRACE_MS))
            return 0;
    }
}

static _Noreturn void give_back_and_leave(void)
{
    give_back();
    leave_to_python();
}

static void open_node(void)
{
    struct message m;
    struct timeval patience = {.tv_sec = 3};
    int fds[8], fd_count;
    setsockopt(node.daemon, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    if (ask_open(node.daemon, node.name, &m, fds, &fd_count) || fd_count != 3 || take_array(&m) != 5)
        leave_to_python();
    node.handle = take_integer(&m);
    node.sock = fds[2];
    if (take_array(&m) != NODE_INFO)
        give_back_and_leave();
    take_text(&m, node.opened, sizeof node.opened);
    node.class = take_integer(&m);
    pass(&m, 0); /* read only */
    node.count = take_array(&m);
}

/* ---- what is written -------------------------------------------------------------------------- */

/* Whether choose_channels finds what it wants; it leaves, which must not happen before the node is given back. */
static int has_channels(void)
{
    const int *given = node.flags.given;
    const double *value = node.flags.value;
    double low = given['n'] ? value['n'] : given['l'] ? value['l'] : 0;
    double high = given['n'] ? value['n'] : given['h'] ? value['h'] : node.count - 1;
    return !(given['n'] && (given['l'] || given['h'])) && low <= high && high < node.count;
}

static void choose_columns(void)
{
    int quantity = 0, some = 0;
    for (const struct column *c = COLUMNS; c->letter; c++) {
        some |= node.flags.given[(int)c->letter];
        quantity |= c->quantity && node.flags.given[(int)c->letter];
    }
    if (node.class != AXIS) {
        if (some)
            give_back_and_leave();
        node.column[node.columns++] = node.class == BINARY ? &BITS : &VALUE;
        return;
    }
    for (const struct column *c = COLUMNS; c->letter; c++)
        if (node.flags.given[(int)c->letter] || (c->letter == 'p' && !quantity)) {
            node.column[node.columns++] = c;
            node.mode |= c->flag;
        }
}

static int is_whole(double value)
{
    return value == trunc(value) && fabs(value) <= MOST_WHOLE;
}

/* Make the records; returns their size. */
static size_t put_records(uint8_t *data)
{
    size_t size = node.class == AXIS ? AXIS_SIZE : node.class == BINARY ? BINARY_SIZE : ANALOG_SIZE, n = 0;
    const double *value = numbers;
    if ((node.high - node.low + 1) * node.columns != number_count || number_count * size > MOST_DATA)
        give_back_and_leave();
    for (int64_t channel = node.low; channel <= node.high; channel++, n += size) {
        int32_t index = channel;
        memset(data + n, 0, size);
        memcpy(data + n, &index, sizeof index);
        if (node.class == AXIS)
            memcpy(data + n + MODE_AT, &node.mode, sizeof node.mode);
        for (int i = 0; i < node.columns; i++, value++) {
            int64_t whole = node.column[i]->whole && is_whole(*value) ? (int64_t)*value : 0;
            if (node.column[i]->whole && !is_whole(*value))
                give_back_and_leave();
            memcpy(data + n + node.column[i]->at, node.column[i]->whole ? (void *)&whole : (void *)value, 8);
        }
    }
    return n;
}

/* Whether the motion that has been written comes to an end of its own. */
static int has_end(void)
{
    int ends = node.flags.given['t'];
    for (int i = 0; i < node.columns; i++)
        ends |= node.column[i]->letter == 'p';
    for (int i = 0; i < number_count; i++)
        if (node.column[i % node.columns]->letter == 't' && numbers[i] < 0)
            return 0;
    return ends;
}

/* ---- from the write on -------------------------------------------------------------------------- */

static _Noreturn void end(const char *text)
{
    committed = NULL;
    if (!give_back())
        fail("close: the daemon does not answer; is its process hung?");
    if (!text)
        _exit(0);
    fail(text);
}

static void no_answer(void)
{
    char text[MOST_NAME + 64];
    snprintf(text, sizeof text, "receive on node %s: not an answer", node.opened);
    end(text);
}

static void told(struct message *m)
{
    static char raw[MAX_PACKET + 1], text[4 * sizeof raw];
    take_text(m, raw, sizeof raw);
    put_printable(text, raw);
    end(text);
}

/* Wait for the answer to a request; tell the driver meanwhile that this program lives. */
static void await(int64_t number)
{
    static uint8_t answer[MAX_PACKET];
    char text[MOST_NAME + 128];
    for (;;) {
        struct pollfd ready = {node.sock, POLLIN, 0};
        if (!poll(&ready, 1, LEASE_MS / 3)) {
            if (send(node.sock, KEEPALIVE, sizeof KEEPALIVE, MSG_NOSIGNAL) < 0)
                ready.revents = POLLIN;
            else
                continue;
        }
        ssize_t got = recv(node.sock, answer, sizeof answer, MSG_DONTWAIT);
        if (got < 0 && (errno == EAGAIN || errno == EINTR))
            continue;
        if (got < 0 && errno == ECONNRESET) /* it is told once, ahead of what is still there to read */
            got = recv(node.sock, answer, sizeof answer, MSG_DONTWAIT);
        if (got <= 0) {
            snprintf(text, sizeof text, "node %s: the process behind it has gone; connect or open again", node.opened);
            end(text);
        }
        struct message m = {answer, answer + got};
        int64_t parts = take_array(&m);
        if (parts < 4 || parts > 6 || take_integer(&m))
            no_answer();
        int64_t about = take_integer(&m), refused = take_integer(&m);
        if (!about || (about == number && refused))
            told(&m);
        if (about == number)
            return;
    }
}

static void send_write(const uint8_t *data, size_t size)
{
    static uint8_t packet[MOST_DATA + 16];
    size_t n = 0;
    int replaces = node.class == AXIS;
    for (int i = 0; i < node.columns; i++)
        replaces &= !strchr("tms", node.column[i]->letter) || !node.column[i]->letter;
    const uint8_t head[] = {0x95, WRITE_VERB, WRITE_NUMBER, replaces ? REPLACE : APPEND, 0xC0};
    memcpy(packet, head, sizeof head);
    n = sizeof head;
    packet[n++] = size < 256 ? 0xC4 : 0xC5;
    if (size >= 256)
        packet[n++] = size >> 8;
    packet[n++] = size & 255;
    memcpy(packet + n, data, size);
    if (send(node.sock, packet, n + size, MSG_NOSIGNAL) < 0)
        await(WRITE_NUMBER); /* which finds why */
}

int main(int argc, char **argv)
{
    static uint8_t data[MOST_DATA];
    struct message m;
    int fds[8], fd_count;
    be_tool(argc, argv);
    node.daemon = connect_to_daemon();
    if (ask(node.daemon, HELLO, sizeof HELLO, HELLO_NUMBER, &m, fds, &fd_count))
        leave_to_python();
    open_node();
    if (!has_channels())
        give_back_and_leave();
    choose_channels(&node.flags, node.count, &node.low, &node.high);
    choose_columns();
    size_t size = put_records(data);
    committed = no_answer;
    send_write(data, size);
    await(WRITE_NUMBER);
    if (node.class == AXIS && !all.given['W'] && has_end()) {
        if (send(node.sock, WAIT_IDLE, sizeof WAIT_IDLE, MSG_NOSIGNAL) < 0 && errno != EPIPE && errno != ECONNRESET)
            no_answer();
        await(IDLE_NUMBER);
    }
    if (node.class != AXIS) {
        char text[2 * MOST_NAME];
        committed = NULL;
        if (!give_back())
            fail("close: the daemon does not answer; is its process hung?");
        snprintf(text, sizeof text, "%s: safe again now that devout ends; -H holds what was written", node.name);
        say(text);
        _exit(0);
    }
    end(NULL);
}
